"""Pictures of closed-loop results: trials over the start error, the confusion matrix, an insertion frame by frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

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

Image = NDArray[np.uint8]


def _pyplot() -> Any:
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    return plt


def draw_scatter(rows: list[Row], path: Path, controller: str = "belief") -> None:
    """The paper's scatter picture: number of trials over the start error, one panel an object."""
    plt = _pyplot()
    mine = [row for row in rows if row["controller"] == controller]
    scenes = in_order(row["scene"] for row in mine)
    lines = max(2, -(-len(scenes) // 4))
    figure, axes = plt.subplots(
        lines, 4, figsize=(15, 3.5 * lines), sharex=True, sharey=True, squeeze=False, layout="constrained"
    )
    dots = None
    for axis in axes.flat[len(scenes) :]:
        axis.set_visible(False)
    for axis, scene in zip(axes.flat, scenes, strict=False):
        played = [row for row in mine if row["scene"] == scene]
        x, theta = [row["x_mm"] for row in played], [row["theta_deg"] for row in played]
        trials = [trials_of(row) for row in played]
        dots = axis.scatter(x, theta, c=trials, vmin=1, vmax=FAILED_COUNTS_AS, cmap="viridis", s=18)
        axis.set_title(f"{title_of(scene)} (simulated)\nn = {len(played)}, mean {np.mean(trials):.2f}", fontsize=10)
        axis.set_xlabel("x error, mm")
        axis.set_ylabel("yaw error, deg")
    if dots is not None:
        figure.colorbar(dots, ax=axes, label="trials (16 = failed)", shrink=0.8)
    figure.savefig(path, dpi=90)
    plt.close(figure)


def draw_confusion(rows: list[Row], path: Path) -> None:
    """Direction classes: truth against the networks' most probable class, training and new objects."""
    plt = _pyplot()
    names = list(SIGNS)
    figure, axes = plt.subplots(1, 2, figsize=(12, 5.2))
    training = {scene for scene in in_order(row["scene"] for row in rows) if trained_on(scene)}
    for axis, new, title in zip(axes, (False, True), ("training objects", "new objects"), strict=True):
        counts = confusion([row for row in rows if (row["scene"] in training) != new])
        share = counts / np.maximum(counts.sum(1, keepdims=True), 1)
        axis.imshow(share, vmin=0, vmax=1, cmap="Blues")
        for i, j in zip(*np.nonzero(counts), strict=True):
            axis.text(j, i, str(counts[i, j]), ha="center", va="center", fontsize=8)
        right = np.trace(counts) / max(1, counts.sum())
        axis.set_title(f"{title} (simulated): {right:.1%} of {counts.sum()} attempts", fontsize=10)
        axis.set_xticks(range(9), names)
        axis.set_yticks(range(9), names)
        axis.set_xlabel("most probable class")
        axis.set_ylabel("true class")
    figure.tight_layout()
    figure.savefig(path, dpi=90)
    plt.close(figure)


def draw_filmstrip(attempts: list[Row], title: str, path: Path) -> None:
    """One insertion: a row an attempt.

    An attempt has ``frames`` [(caption, uint8 image)], ``belief`` ((x_mm, theta_deg, probability) or None), ``error``
    (the truth before it) and ``move`` (None after the last).
    """
    plt = _pyplot()
    columns = max(len(entry["frames"]) for entry in attempts) + 1
    figure, axes = plt.subplots(len(attempts), columns, figsize=(2.3 * columns, 2.5 * len(attempts)), squeeze=False)
    for axis in axes.flat:
        axis.set_axis_off()
    for line, (number, entry) in zip(axes, enumerate(attempts, 1), strict=True):
        for axis, (caption, image) in zip(line, entry["frames"], strict=False):
            axis.imshow(image[..., ::-1])
            axis.set_title(f"{number}: {caption}", fontsize=8)
        if entry["belief"] is not None:
            _draw_belief(line[-1], entry)
    figure.suptitle(title, fontsize=10)
    figure.tight_layout()
    figure.savefig(path, dpi=80)
    plt.close(figure)


def _draw_belief(axis: Any, entry: Row) -> None:
    x, theta, probability = entry["belief"]
    axis.set_axis_on()
    axis.pcolormesh(x, theta, probability.T, cmap="magma")
    axis.plot(*entry["error"], "c+", ms=9, label="truth")
    axis.plot(-entry["move"][0], -entry["move"][1], "wx", ms=7, label="aim")
    axis.set(xlim=(-18, 18), ylim=(-18, 18))
    axis.tick_params(labelsize=6)
    axis.legend(fontsize=6, loc="upper left")
    axis.set_title(f"belief; move {entry['move'][0]:+.1f} mm, {entry['move'][1]:+.1f} deg", fontsize=8)
