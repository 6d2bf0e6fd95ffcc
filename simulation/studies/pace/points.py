"""The settings that are played against each other, and the insertions of each: all begin from the same starts."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from simulation.closed_loop.benchmark import drawn_starts
from simulation.closed_loop.campaign import Task
from simulation.closed_loop.job import job_in
from simulation.scene.drawn import fastest_mm_s
from simulation.scene.scene import Scene, SceneError
from simulation.scene.worlds import World

Tables = Mapping[str, Any]
TODAY = "as shipped"
"""What the others are compared with: the client without settings of its own."""


class Point(NamedTuple):
    """One choice of settings.

    ``client`` are tables of the client's configuration as in `cell.toml`, ``fps`` frames a second of the cameras,
    ``folder`` which networks of the models' folder decide.
    """

    name: str
    client: Tables
    fps: float = 30.0
    controller: str = "belief"
    folder: str = "."


def ramp(speed_mm_s: float, acceleration_mm_s2: float, jerk_mm_s3: float) -> dict[str, float]:
    """A table of the client's ramps."""
    return {"speed_mm_s": speed_mm_s, "acceleration_mm_s2": acceleration_mm_s2, "jerk_mm_s3": jerk_mm_s3}


def client(
    probing_mm_s: float = 10.0,
    *,
    brisk: bool = True,
    clearance_mm: float = 3.0,
    lift_mm: float | None = None,
    fast_mm_s: float | None = None,
    air_mm_s: float = 60.0,
) -> Tables:
    """Tables of a client; ``brisk``: harder ramps.

    What ships is ``client(brisk=False, clearance_mm=5.0)``.
    """
    pace = {"lift_mm": lift_mm, "fast_mm_s": fast_mm_s}
    tables: dict[str, Any] = {
        "task": {"approach_clearance_mm": clearance_mm},
        "pace": {key: value for key, value in pace.items() if value is not None},
        "ramps": {
            "travel": ramp(air_mm_s, 1400.0, 60000.0) if brisk else ramp(55.0, 300.0, 5000.0),
            "retract": ramp(50.0, 1400.0, 60000.0) if brisk else ramp(25.0, 200.0, 4000.0),
            "descend": ramp(probing_mm_s, 1000.0, 30000.0) if brisk else ramp(probing_mm_s, 100.0, 2000.0),
        },
    }
    if fast_mm_s is not None:  # the yaw of a move in the air keeps the same profile, in deg
        tables["limits"] = {"max_descent_speed_mm_s": fast_mm_s, "max_turn_deg_s": max(60.0, air_mm_s)}
    return tables


POINTS = (
    Point(TODAY, client(brisk=False, clearance_mm=5.0)),
    Point("brisk, from 5 mm", client(clearance_mm=5.0)),
    Point("brisk", client()),
    Point("brisk, probes at 13.5 mm/s", client(13.5)),
    Point("brisk, fast, 60 Hz", client(fast_mm_s=25.0), 60.0),
    Point("brisk, fast, 60 Hz, probes at 15 mm/s", client(15.0, fast_mm_s=25.0), 60.0),
    Point("the same from 5 mm, then 3 mm up", client(15.0, clearance_mm=5.0, lift_mm=3.0, fast_mm_s=25.0), 60.0),
    Point("the same, joint density", client(15.0, fast_mm_s=25.0), 60.0, folder="joint"),
    Point("the same, heuristic", client(15.0, fast_mm_s=25.0), 60.0, "heuristic"),
    Point(
        "probes at 10 mm/s, 80 mm/s in the air, joint density",
        client(fast_mm_s=25.0, air_mm_s=80.0),
        60.0,
        folder="joint",
    ),
    Point(
        "probes at 12 mm/s, 80 mm/s in the air, joint density",
        client(12.0, fast_mm_s=25.0, air_mm_s=80.0),
        60.0,
        folder="joint",
    ),
    Point("as shipped, networks of eight frames", client(brisk=False, clearance_mm=5.0), folder=".."),
)


def tasks(
    points: Sequence[Point], worlds: Sequence[World], objects: Mapping[str, Scene], count: int, seed: int, models: Path
) -> list[Task]:
    """``count`` insertions of each object at each point, the worlds in turn; one start by all points, then the next.

    A world keeps all but the rate of its cameras, which is the point's; no point is faster in it than a cell is run
    with care. Raises SceneError for an object that no world can hold.
    """
    starts = {name: drawn_starts(scene, count, seed + scene.number) for name, scene in objects.items()}
    return [
        Task(
            models / point.folder,
            job_in(
                world,
                name,
                index,
                starts[name][index],
                seed * 100_000 + index,
                controller=point.controller,
                condition=point.name,
                changes={**world.changes, "camera.fps": point.fps},
                client=with_care(point, world),
            ),
        )
        for index in range(count)
        for place, (name, scene) in enumerate(objects.items())
        for world in [_world_of(worlds, index * len(objects) + place, scene)]
        for point in points
    ]


def _world_of(worlds: Sequence[World], place: int, scene: Scene) -> World:
    """The world whose turn it is, or the next in which the object can be held."""
    for step in range(len(worlds)):
        world = worlds[(place + step) % len(worlds)]
        try:
            world.around(scene)
        except SceneError:
            continue
        return world
    raise SceneError(f"{scene.name}: none of {len(worlds)} worlds can hold it")


def with_care(point: Point, world: World) -> Tables:
    """The point's tables, no faster than cameras and stop of a world allow; see `drawn.fastest_mm_s`."""
    late_s = 1e-3 * world.changes.get("camera.latency_ms", 0.0) + world.unstated.stop_lag_s
    top_mm_s = fastest_mm_s(point.fps, late_s)
    tables: dict[str, Any] = json.loads(json.dumps(point.client))
    descend, pace = tables["ramps"]["descend"], tables["pace"]
    descend["speed_mm_s"] = min(descend["speed_mm_s"], top_mm_s)
    if "fast_mm_s" in pace:
        pace["fast_mm_s"] = min(pace["fast_mm_s"], top_mm_s)
        pace["fast_travel_mm"] = max(1.5, 0.1 * pace["fast_mm_s"])
    return tables
