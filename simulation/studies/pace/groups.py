"""Seconds per box of the release, by object and by properties of the world."""

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from simulation.closed_loop.statistics import Row
from simulation.scene.rubber import shear_reach_pitches
from simulation.scene.scene import Scene
from simulation.scene.worlds import load_scene
from simulation.studies.pace.resampled import a_box, total_s

PARTS = 3  # groups of about equal size per quantity


class Quantity(NamedTuple):
    """A quantity for grouping insertions: a name, how to read it from a scene, and how to print its bounds."""

    name: str
    of: Callable[[Scene], float]
    spec: str


QUANTITIES = (
    Quantity("camera rate, frames/s", lambda scene: scene.fps, ".0f"),
    Quantity("shear reach, marker pitches", shear_reach_pitches, ".2f"),
    Quantity("grasp height, mm", lambda scene: scene.grasp.height_mm, ".0f"),
)


def groups(rows: Sequence[Row]) -> list[Row]:
    """One row for each outline and for each third of each quantity, in this order."""
    scenes = [load_scene(row["scene"]).varied(row["changes"]) for row in rows]
    outlines = np.array([scene.object.shape for scene in scenes])
    by_object = [_group("object", str(name), rows, outlines == name) for name in np.unique(outlines)]
    return by_object + [group for quantity in QUANTITIES for group in _thirds(quantity, rows, scenes)]


def _thirds(quantity: Quantity, rows: Sequence[Row], scenes: Sequence[Scene]) -> list[Row]:
    values = np.array([quantity.of(scene) for scene in scenes])
    edges = np.quantile(values, np.linspace(0.0, 1.0, PARTS + 1))
    place = np.digitize(values, edges[1:-1])
    bounds = [f"{low:{quantity.spec}} to {high:{quantity.spec}}" for low, high in pairwise(edges)]
    return [
        _group(quantity.name, name, rows, place == part) for part, name in enumerate(bounds) if (place == part).any()
    ]


def _group(by: str, name: str, rows: Sequence[Row], chosen: Sequence[bool]) -> Row:
    mine = [row for row, taken in zip(rows, chosen, strict=True) if taken]
    seconds = [total_s(row) for row in mine]
    return {
        "by": by,
        "name": name,
        "insertions": len(mine),
        "inserted": sum(row["inserted"] for row in mine),
        "seconds_a_box": list(a_box(mine)),
        "median": float(np.median(seconds)),
        "95": float(np.quantile(seconds, 0.95)),
        "attempts": float(np.mean([row["attempts"] for row in mine])),
    }
