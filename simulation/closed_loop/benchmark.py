"""Every world with every object: what `evaluate --worlds` plays, and its rows."""

import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from simulation.closed_loop.campaign import Task
from simulation.closed_loop.job import job_in
from simulation.closed_loop.lockstep import hash_seed
from simulation.closed_loop.statistics import Row, class_of, ends, first_decisions, title_of
from simulation.scene.scene import Scene, SceneError
from simulation.scene.worlds import World

UNLIKE_TRAINING = "untrained", "out_of_distribution"
"""Refusals of what the networks do not know: what that is follows them, and then its figures."""


def drawn_starts(scene: Scene, count: int, seed: int) -> list[tuple[float, float]]:
    """Start errors [count] (mm, deg) of one object, uniform in its range."""
    rng = np.random.default_rng(seed)
    starts = rng.uniform(-1.0, 1.0, (count, 2)) * (scene.x_range_mm, scene.theta_range_deg)
    return [(float(x), float(theta)) for x, theta in starts]


def tasks(
    worlds: Sequence[World], objects: Mapping[str, Scene], count: int, seed: int, models: Path, made_by: str, **job: Any
) -> list[Task]:
    """``count`` insertions of each pair, ordered by start. An object has the same starts in every world.

    ``job``: fields of `Job` shared by all. Raises SceneError where a world and an object do not fit.
    """
    for world in worlds:
        for scene in objects.values():
            world.around(scene)
    starts = {name: drawn_starts(scene, count, hash_seed(seed, scene.number)) for name, scene in objects.items()}
    return [
        Task(
            models,
            job_in(world, name, index, starts[name][index], hash_seed(seed, world.number, scene.number, index), **job),
            made_by,
        )
        for index in range(count)
        for world in worlds
        for name, scene in objects.items()
    ]


def held_in(world: World, objects: Mapping[str, Scene]) -> dict[str, Scene]:
    """The objects that can be held in a world, by their names, each in that world."""
    held = {}
    for name, scene in objects.items():
        with suppress(SceneError):
            held[name] = world.around(scene)
    return held


def check_sensors(scenes: Iterable[tuple[World, Scene]], models: Path) -> None:
    """Raise ValueError for a scene, in its world, whose sensor the networks in the folder do not read."""
    from simulation.closed_loop.play import models_of  # imports the service's pipeline

    card = models_of(models).card
    read, scale = card.frame, card.profile.mm_per_px
    for world, scene in scenes:
        sensor = scene.sensor
        if sensor.rectified != read or not math.isclose(sensor.mm_per_px, scale, rel_tol=1e-3):
            raise ValueError(
                f"world {world.name}, object {scene.name}: pictures of the sensor {sensor.name} are "
                f"{sensor.width_px} x {sensor.height_px} px of {sensor.mm_per_px:g} mm; the networks in "
                f"{models} read {read.width_px} x {read.height_px} px of {scale:g} mm"
            )


def table(rows: Sequence[Row]) -> list[Row]:
    """One row per (world, object), in the order in which they were first played."""
    pairs = dict.fromkeys((row["condition"], row["scene"]) for row in rows)
    return [
        {
            "world": world,
            "object": title_of(scene),
            **figures(mine := [row for row in rows if (row["condition"], row["scene"]) == (world, scene)]),
            "worst_block_mm": max(row["course"]["block_mm"] for row in mine),
            "reasons": dict(Counter(_cause(row["reason"]) for row in mine if row["reason"]).most_common()),
        }
        for world, scene in pairs
    ]


def figures(rows: Sequence[Row]) -> Row:
    """How insertions ended, what the networks first decided in them, and the largest force on the object, N."""
    return {**ends(rows), **first_answers(rows), "worst_force_n": max(row["course"]["force_n"] for row in rows)}


def first_answers(rows: Sequence[Row]) -> Row:
    """Directions, absolute errors and 90 % interval coverage of the networks' first decisions; None without any."""
    right, off, covered = 0, [], []
    firsts = [trial for trial in first_decisions(rows) if trial["decision"]["class_probabilities"]]
    for trial in firsts:
        (x, theta), decision = trial["error_before"], trial["decision"]
        estimate, classes = decision["estimate"], decision["class_probabilities"]
        right += class_of(x, theta) == max(classes, key=classes.get, default="")
        off.append((abs(estimate["dx_mm"] - x), abs(estimate["dtheta_deg"] - theta)))
        covered.append((_holds(estimate["interval_x_mm"], x), _holds(estimate["interval_theta_deg"], theta)))
    mae = np.mean(off, axis=0).tolist() if off else (None, None)
    shares = np.mean(covered, axis=0).tolist() if covered else (None, None)
    return {
        "direction_right": right,
        "direction_n": len(firsts),
        "mae_x_mm": mae[0],
        "mae_theta_deg": mae[1],
        "covered_x": shares[0],
        "covered_theta": shares[1],
    }


def _holds(interval: Sequence[float] | None, truth: float) -> bool:
    return interval is not None and interval[0] <= truth <= interval[1]


def _cause(reason: str) -> str:
    """Who ended it and why, without figures; whole for a miswired cell, and for a plan that is never allowed."""
    if "contradictory" in reason or reason.startswith("limits: plan: "):
        return reason
    if any(f": {kind}: " in reason for kind in UNLIKE_TRAINING):
        return re.split(r" is \d| \(", reason)[0]
    parts = reason.split(": ")
    return ": ".join(parts[: 3 if {"refused", "no_decision"} & set(parts) else 2])
