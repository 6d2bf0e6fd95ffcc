"""`python -m simulation accuracy`: what physics accuracy costs in time, against a converged reference.

Each scene is poked once (1.5 mm past touchdown, friction partly slipping) with one knob turned at a time; errors are
those of the held object's pose, of the force and of the markers at the end of the poke. CPU time is the best of
several runs.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from simulation.rig import Cell, CellState
from simulation.scene import load_scene

SCENES = ("rectangle", "circle", "ellipse", "hexagon")
POKE = {"x_mm": 8.0, "theta_deg": 5.0, "past_touchdown_mm": 1.5}
REFERENCE: dict[str, Any] = {"numerics__load_step_mm": 0.01, "gel__node_rows": 60, "gel__node_columns": 63}
SETTINGS: dict[str, dict[str, Any]] = {
    "load step 0.50 mm": {"numerics__load_step_mm": 0.5},
    "load step 0.34 mm": {"numerics__load_step_mm": 0.34},
    "default: load step 0.17 mm, 20 x 21 nodes": {},
    "load step 0.04 mm": {"numerics__load_step_mm": 0.04},
    "load step 0.01 mm": {"numerics__load_step_mm": 0.01},
    "10 x 11 nodes": {"gel__node_rows": 10, "gel__node_columns": 11},
    "40 x 42 nodes": {"gel__node_rows": 40, "gel__node_columns": 42},
    "40 x 42 nodes, load step 0.04 mm": {
        "gel__node_rows": 40,
        "gel__node_columns": 42,
        "numerics__load_step_mm": 0.04,
    },
    "edge friction left out": {"effects__edge_friction": "off"},
    "gravity forced on": {"effects__gravity": "on"},
}


@dataclass(frozen=True, slots=True)
class Cost:
    """One scene under one setting: errors against the scene's reference, and CPU time of the poke."""

    scene: str
    setting: str
    cpu_ms: float
    position_um: float
    turn_deg: float
    force_n: float
    markers_um: float


def poke(scene: str, changes: dict[str, Any], repeats: int) -> tuple[CellState, float]:
    """End state of the poke and its best CPU time in ms."""
    settings = {"grasp__pre_tilt_spread_deg": 0.0, "grasp__pre_yaw_spread_deg": 0.0, **changes}
    cell, best = Cell(load_scene(scene, **settings)), float("inf")
    state = cell.look()
    for _ in range(repeats):
        state = cell.regrasp(POKE["x_mm"], POKE["theta_deg"])
        x, y, z, yaw = cell.pose
        start = time.process_time()
        state = cell.move_to(x, y, z - 5.0 - POKE["past_touchdown_mm"], float(np.degrees(yaw)))
        best = min(best, 1e3 * (time.process_time() - start))
    return state, best


def compare(scene: str, setting: str, state: CellState, reference: CellState, cpu_ms: float) -> Cost:
    """Errors of a state against the reference's."""
    shift = state.in_hand - reference.in_hand
    markers = (state.gel - reference.gel)[..., :2]
    return Cost(
        scene=scene,
        setting=setting,
        cpu_ms=cpu_ms,
        position_um=float(1e3 * np.linalg.norm(shift[:3])),
        turn_deg=float(np.degrees(np.linalg.norm(shift[3:]))),
        force_n=float(np.linalg.norm((state.wrench_n_nmm - reference.wrench_n_nmm)[:3])),
        markers_um=float(1e3 * np.sqrt(np.mean(np.sum(markers**2, axis=-1)))),
    )


def measure(repeats: int) -> list[Cost]:
    """Every setting on every scene."""
    out = []
    for scene in SCENES:
        reference, _ = poke(scene, REFERENCE, 1)
        for setting, changes in SETTINGS.items():
            state, cpu_ms = poke(scene, changes, repeats)
            out.append(compare(scene, setting, state, reference, cpu_ms))
    return out


def as_table(costs: list[Cost]) -> str:
    """Markdown table."""
    lines = [
        "| scene | setting | CPU ms | position um | turn deg | force N | markers um RMS |",
        "|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {c.scene} | {c.setting} | {c.cpu_ms:.2f} | {c.position_um:.2f} | {c.turn_deg:.4f} | {c.force_n:.3f} "
        f"| {c.markers_um:.2f} |"
        for c in costs
    ]
    return "\n".join(lines)


def draw(costs: list[Cost], path: Path) -> None:
    """Marker error over CPU time, one panel a scene."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, panels = plt.subplots(1, len(SCENES), figsize=(16, 4.5), sharey=True)
    for panel, scene in zip(panels, SCENES, strict=True):
        for cost in (c for c in costs if c.scene == scene):
            panel.loglog(cost.cpu_ms, cost.markers_um, "o", label=cost.setting)
        panel.set_title(scene)
        panel.set_xlabel("CPU time of a poke, ms")
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("marker error against the reference, um RMS")
    panels[-1].legend(fontsize=6)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main(arguments: list[str]) -> int:
    """Measure, then write accuracy.md, accuracy.json and accuracy.png."""
    parser = argparse.ArgumentParser(prog="python -m simulation accuracy", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder for the three files (default docs)")
    parser.add_argument("--repeats", type=int, default=5, help="runs of which the fastest counts (default 5)")
    given = parser.parse_args(arguments)
    if given.repeats < 1 or not given.out.is_dir():
        raise ValueError(f"expected --repeats >= 1 and an existing folder, got {given.repeats} and {given.out}")
    costs = measure(given.repeats)
    table = as_table(costs)
    poked = f"x {POKE['x_mm']} mm, theta {POKE['theta_deg']} deg, {POKE['past_touchdown_mm']} mm past touchdown"
    head = (
        f"# What physics accuracy costs\n\nPoke: {poked}. Reference: 60 x 63 nodes a pad, load step 0.01 mm, same tier "
        "(bristle). CPU time is the best of several runs on one core.\n\n"
    )
    (given.out / "accuracy.md").write_text(
        f"{head}![marker error over CPU time](accuracy.png)\n\n{table}\n\nMade by `make accuracy`.\n", encoding="utf-8"
    )
    (given.out / "accuracy.json").write_text(json.dumps([asdict(c) for c in costs], indent=1) + "\n", encoding="utf-8")
    draw(costs, given.out / "accuracy.png")
    print(table)
    return 0
