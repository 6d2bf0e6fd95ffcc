"""Figures of closed-loop results: trials over the start error, the confusion matrix, an insertion frame by frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from reporting import figure
from simulation.closed_loop.baselines import SIGNS
from simulation.closed_loop.statistics import (
    FAILED_COUNTS_AS,
    Row,
    confusion,
    in_order,
    title_of,
    trained_on,
    trials_of,
)


def draw_scatter(rows: list[Row], path: Path, controller: str = "belief") -> None:
    """The paper's scatter picture: number of trials over the start error, one panel an object."""
    mine = [row for row in rows if row["controller"] == controller]
    scenes = in_order(row["scene"] for row in mine)
    lines = max(2, -(-len(scenes) // 4))
    with figure.drawing(path, lines, 4, size=(15, 3.5 * lines), sharex=True, sharey=True) as panels:
        for panel in panels.flat[len(scenes) :]:
            panel.set_visible(False)
        for panel, scene in zip(panels.flat, scenes, strict=False):
            played = [row for row in mine if row["scene"] == scene]
            trials = [trials_of(row) for row in played]
            x, theta = [row["x_mm"] for row in played], [row["theta_deg"] for row in played]
            dots = panel.scatter(x, theta, c=trials, vmin=1, vmax=FAILED_COUNTS_AS, cmap="viridis", s=18)
            panel.set_title(f"{title_of(scene)} (simulated)\nn = {len(played)}, mean {np.mean(trials):.2f}")
            panel.set(xlabel="x error, mm", ylabel="yaw error, deg")
        if scenes:
            panels[0, 0].figure.colorbar(dots, ax=panels, label="trials (16 = failed)", shrink=0.8)


def draw_confusion(rows: list[Row], path: Path) -> None:
    """Direction classes: truth against the networks' most probable class, training and new objects."""
    with figure.drawing(path, 1, 2, size=(12, 5.2)) as panels:
        for panel, training in zip(panels[0], (True, False), strict=True):
            counts = confusion([row for row in rows if trained_on(row["scene"]) == training])
            right = np.trace(counts) / max(1, counts.sum())
            title = f"{'training' if training else 'new'} objects (simulated): {right:.1%} of {counts.sum()} attempts"
            figure.confusion(panel, counts, list(SIGNS), title, "most probable class")


def draw_filmstrip(attempts: list[Row], title: str, path: Path) -> None:
    """One insertion: a row an attempt.

    An attempt has ``frames`` [(caption, uint8 image)], ``belief`` ((x_mm, theta_deg, probability) or None), ``error``
    (the truth before it) and ``move`` (None after the last).
    """
    lines, columns = len(attempts), max(len(attempt["frames"]) for attempt in attempts) + 1
    with figure.drawing(path, lines, columns, size=(2.3 * columns, 2.5 * lines), dpi=80) as panels:
        panels[0, 0].figure.suptitle(title)
        for panel in panels.flat:
            panel.set_axis_off()
        for line, (number, attempt) in zip(panels, enumerate(attempts, 1), strict=True):
            for panel, (caption, image) in zip(line, attempt["frames"], strict=False):
                panel.imshow(image[..., ::-1])
                panel.set_title(f"{number}: {caption}", fontsize=8)
            if attempt["belief"] is not None:
                _draw_belief(line[-1], attempt)


def _draw_belief(panel: Any, attempt: Row) -> None:
    x, theta, probability = attempt["belief"]
    panel.set_axis_on()
    panel.grid(visible=False)
    panel.pcolormesh(x, theta, probability.T, cmap="magma")
    panel.plot(*attempt["error"], "c+", ms=9, label="truth")
    panel.plot(-attempt["move"][0], -attempt["move"][1], "wx", ms=7, label="aim")
    panel.set(xlim=(-18, 18), ylim=(-18, 18))
    panel.tick_params(labelsize=6)
    panel.legend(fontsize=6, loc="upper left")
    panel.set_title(f"belief; move {attempt['move'][0]:+.1f} mm, {attempt['move'][1]:+.1f} deg", fontsize=8)
