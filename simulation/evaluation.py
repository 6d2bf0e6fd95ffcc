"""Statistics, table, pictures and JSON of closed-loop results; nothing here runs an insertion."""

from __future__ import annotations

import math
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

Row = dict[str, Any]

OBJECTS = ("rectangle", "circle", "ellipse", "hexagon", "white_box", "vitamin", "can", "mustard")
TRAINING_OBJECTS = OBJECTS[:4]
FAILED_COUNTS_AS = 16
# Table I of the paper, measured on the real robot: success %, mean trials, maximum
PAPER: dict[str, tuple[float, float, str]] = {
    "rectangle": (100.0, 4.7, "11"),
    "circle": (100.0, 2.97, "5"),
    "ellipse": (100.0, 2.77, "8"),
    "hexagon": (100.0, 2.4, "6"),
    "white_box": (93.3, 6.53, ">15"),
    "vitamin": (96.7, 2.97, ">15"),
    "can": (93.3, 7.4, ">15"),
    "mustard": (100.0, 3.6, "9"),
}


def wilson(successes: int, count: int, z: float = 1.96) -> tuple[float, float]:
    """Wilson score interval of a share (Wilson 1927), both ends in 0..1."""
    if count == 0:
        return 0.0, 1.0
    p = successes / count
    centre = (p + z * z / (2 * count)) / (1 + z * z / count)
    half = z * math.sqrt(p * (1 - p) / count + z * z / (4 * count * count)) / (1 + z * z / count)
    return max(0.0, centre - half), min(1.0, centre + half)


def start_errors(count: int, seed: int) -> list[tuple[float, float]]:
    """The paper's protocol: the four extremes first, then uniform random errors, mm and deg."""
    rng = np.random.default_rng(seed)
    extremes = [(15.0, 15.0), (15.0, -15.0), (-15.0, 15.0), (-15.0, -15.0)]
    randoms = [(float(x), float(t)) for x, t in rng.uniform(-15.0, 15.0, (max(0, count - 4), 2))]
    return (extremes + randoms)[:count]


def trials_of(row: Row) -> int:
    """Attempts of an insertion, a failure counted as the paper does."""
    return int(row["attempts"]) if row["inserted"] else FAILED_COUNTS_AS


def summarise(rows: list[Row]) -> list[Row]:
    """One summary a (scene, controller, baseline), in the order of OBJECTS."""
    groups: dict[tuple[str, str, str], list[Row]] = defaultdict(list)
    for row in rows:
        groups[row["scene"], row["controller"], row["baseline"]].append(row)
    order = {name: index for index, name in enumerate(OBJECTS)}
    return [_summary(key, groups[key]) for key in sorted(groups, key=lambda k: (k[2], k[1], order.get(k[0], 99)))]


def _summary(key: tuple[str, str, str], rows: list[Row]) -> Row:
    trials = np.array([trials_of(row) for row in rows], float)
    inserted = sum(row["inserted"] for row in rows)
    still = sum(row["block_motion_mm"] < 1.0 for row in rows)
    kept = sum(row["grasp_kept"] for row in rows)
    error = float(trials.std(ddof=1) / math.sqrt(len(trials))) if len(trials) > 1 else math.inf
    return {
        "scene": key[0],
        "controller": key[1],
        "baseline": key[2],
        "insertions": len(rows),
        "inserted": inserted,
        "success": inserted / len(rows),
        "success_interval": wilson(inserted, len(rows)),
        "mean_trials": float(trials.mean()),
        "mean_trials_standard_error": error,
        "max_trials": int(trials.max()),
        "blocks_under_1_mm": still / len(rows),
        "grasp_kept": kept / len(rows),
        "worst_in_hand_mm": max(row["in_hand_mm"] for row in rows),
    }


def table(summaries: list[Row]) -> str:
    """Markdown: ours (simulated) beside the paper's Table I (measured on its robot)."""
    head = "| object | controller | inserted (simulated) | 95 % interval | mean trials | max | blocks < 1 mm |"
    lines = [
        head + " grasp kept | paper: success, mean, max (real robot) |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in summaries:
        low, high = row["success_interval"]
        paper = PAPER.get(row["scene"])
        beside = f"{paper[0]:g} %, {paper[1]:g}, {paper[2]}" if paper else ""
        who = row["controller"] if row["baseline"] == "none" else row["baseline"]
        most = f">{FAILED_COUNTS_AS - 1}" if row["max_trials"] >= FAILED_COUNTS_AS else str(row["max_trials"])
        lines.append(
            f"| {row['scene']} | {who} | {row['inserted']}/{row['insertions']} = {row['success']:.1%} |"
            f" {low:.1%} .. {high:.1%} | {row['mean_trials']:.2f} +- {row['mean_trials_standard_error']:.2f} | {most} |"
            f" {row['blocks_under_1_mm']:.0%} | {row['grasp_kept']:.0%} | {beside} |"
        )
    return "\n".join(lines)


def draw_scatter(rows: list[Row], path: Path) -> None:
    """The paper's scatter picture: number of trials over the start error, one panel an object."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    names = [name for name in OBJECTS if any(row["scene"] == name for row in rows)]
    figure, axes = plt.subplots(2, 4, figsize=(14, 7), sharex=True, sharey=True, squeeze=False)
    dots = None
    for axis in axes.flat[len(names) :]:
        axis.set_visible(False)
    for axis, name in zip(axes.flat, names, strict=False):
        mine = [row for row in rows if row["scene"] == name and row["baseline"] == "none"]
        x, theta = [row["x_mm"] for row in mine], [row["theta_deg"] for row in mine]
        dots = axis.scatter(
            x, theta, c=[trials_of(r) for r in mine], vmin=1, vmax=FAILED_COUNTS_AS, cmap="viridis", s=18
        )
        axis.set_title(f"{name} (simulated)")
        axis.set_xlabel("x error, mm")
        axis.set_ylabel("yaw error, deg")
    if dots is not None:
        figure.colorbar(dots, ax=axes, label="trials (16 = failed)", shrink=0.8)
    figure.savefig(path, dpi=110)
    plt.close(figure)
