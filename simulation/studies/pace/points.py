"""The compared settings, and the insertions of each: all begin from the same starts."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from robot_client.insertion.lease import Lease
from service.contract.wire import PRESS_MM
from simulation.closed_loop.campaign import Task
from simulation.closed_loop.client import longest_travel_mm
from simulation.closed_loop.job import Who
from simulation.scene.scene import APPROACH_MM
from simulation.scene.worlds import World, load_scene
from simulation.studies.drawn_worlds import Start

Tables = Mapping[str, Any]
BEFORE, SHIPPED = "before", "as shipped"
NO_LEGS_MM_S = 3.0  # below any probing speed: no leg of a descent is fast


class Point(NamedTuple):
    """One choice of settings: tables of the client's configuration as in `cell.toml`.

    ``needs``: a requirement that not every cell meets; empty if any cell can run it. ``controller`` and ``networks`` (a
    folder below the released models) are the service's, by default the released ones.
    """

    name: str
    client: Tables
    needs: str = ""
    controller: Who = "belief"
    networks: str = ""

    @property
    def service(self) -> Tables:
        """The service's settings that differ from the release."""
        chosen = {"controller": self.controller} if self.controller != "belief" else {}
        return MappingProxyType(chosen | ({"models": f"models/pressing/{self.networks}"} if self.networks else {}))


def ramp(speed_mm_s: float, acceleration_mm_s2: float, jerk_mm_s3: float) -> dict[str, float]:
    """A table of the client's ramps."""
    return {"speed_mm_s": speed_mm_s, "acceleration_mm_s2": acceleration_mm_s2, "jerk_mm_s3": jerk_mm_s3}


def client(
    probing_mm_s: float = 5.0,
    fast_mm_s: float = 10.0,
    *,
    air_mm_s: float = 80.0,
    lift_mm: float = 3.0,
    press_mm: float = PRESS_MM,
    brisk: bool = False,
    straightens: bool = True,
) -> Tables:
    """Tables of a client, by default as released; ``brisk``: harder ramps; ``straightens``: tilts a turned object."""
    fast_travel_mm = longest_travel_mm(fast_mm_s)
    return {
        "pace": {"fast_mm_s": fast_mm_s, "fast_travel_mm": fast_travel_mm, "lift_mm": lift_mm, "press_mm": press_mm},
        "ramps": {
            "travel": ramp(air_mm_s, 600.0, 10000.0) if brisk else ramp(air_mm_s, 300.0, 5000.0),
            "retract": ramp(40.0, 600.0, 10000.0) if brisk else ramp(25.0, 200.0, 4000.0),
            "descend": ramp(probing_mm_s, 400.0, 8000.0) if brisk else ramp(probing_mm_s, 100.0, 2000.0),
        },
        "limits": {"max_descent_speed_mm_s": max(15.0, fast_mm_s), "max_speed_mm_s": max(80.0, air_mm_s)}
        | ({} if straightens else {"max_straighten_deg": 0.0}),
    }


POINTS = (
    Point(BEFORE, client(10.0, NO_LEGS_MM_S, air_mm_s=55.0, lift_mm=APPROACH_MM, press_mm=1.2, straightens=False)),
    Point(SHIPPED, client()),
    Point("one speed: 10 mm/s all the way", client(10.0, NO_LEGS_MM_S)),
    Point("deep: presses by 1.2 mm", client(press_mm=1.2)),
    Point("high: back up to the approach each time", client(lift_mm=APPROACH_MM)),
    Point("upright tool: a turned part is regrasped, never straightened", client(straightens=False)),
    Point("heuristic: the paper's rule decides", client(), controller="heuristic"),
    Point("joint: one network instead of two", client(), networks="joint"),
    Point(
        "quick: legs of 25 mm/s, 120 in the air",
        client(5.0, 25.0, air_mm_s=120.0, brisk=True),
        needs="cameras of 38 frames a second and an arm that follows its targets within 83 ms",
    ),
)
"""Before and as released; then the release with one default changed; then choices that only some cells can run."""


def tasks(
    points: Sequence[Point], begun: Sequence[Start], seed: int, models: Path, late_s: Sequence[float | None]
) -> list[Task]:
    """Every start at each point, one start by all points, then the next; the client sends a measured shear reach.

    A world keeps everything but the speed of its arm. ``late_s``: what each start's commissioning has measured; without
    that (None) a client refuses to insert, and the start is not played.
    """
    return [
        Task(
            models / point.networks,
            start.job(
                index,
                seed * 1_000_000 + index,
                controller=point.controller,
                condition=point.name,
                client=with_care(point.client, start.world, start.scene, late),
                given_reach=True,
                late_s=late,
            ),
        )
        for index, (start, late) in enumerate(zip(begun, late_s, strict=True))
        for point in points
        if late is not None
    ]


def with_care(tables: Tables, world: World, scene: str, late_s: float | None) -> Tables:
    """Tables of a client that probes no faster than the cameras of a world and its measured lateness, if any, allow.

    A client slows down its fast legs by itself.
    """
    top_mm_s = Lease().late_by(late_s).fastest_mm_s(world.around(load_scene(scene)).fps)
    slowed: dict[str, Any] = json.loads(json.dumps(tables))
    descend = slowed["ramps"]["descend"]
    descend["speed_mm_s"] = min(descend["speed_mm_s"], top_mm_s)
    return slowed
