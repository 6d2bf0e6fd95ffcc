"""What a commissioning's presses at two speeds tell of the lateness of a cell, in lock step."""

from collections.abc import Mapping, Sequence
from functools import partial
from operator import call
from pathlib import Path
from typing import Any

from robot_client.insertion.limits import LimitError
from robot_client.insertion.state import Phase, Plan
from robot_client.session.commission.lateness import PLACE, Press, late_s, next_is_fast, slow_and_fast
from robot_client.session.stops import StopWatch
from simulation.closed_loop.benchmark import held_in
from simulation.closed_loop.client import GUIDANCE_S, trip_s
from simulation.closed_loop.job import Job, job_in
from simulation.closed_loop.lockstep import hash_seed
from simulation.closed_loop.play import Insertion, models_of, stage
from simulation.closed_loop.statistics import Row
from simulation.data.parallel import results
from simulation.data.progress import shown
from simulation.scene.scene import Scene
from simulation.scene.state import PhysicsError
from simulation.scene.worlds import World, load_scene
from simulation.studies.episodes import hangs_askew
from simulation.studies.wiring import BEFORE_SIGNS, by_corner


def timed(world: World, name: str, seed: int, models: Path, **job: Any) -> Row:
    """All presses with an object: measured and true lateness in s, None for one that was not measured.

    As on a cell, a press that fails ends them, and none of them counts.
    ``job``: fields of `Job`. ``robot_s``: time of the robot, including the trip to the fixture and back.
    """
    arm = world.unstated
    start = PLACE[0] * arm.x_sign, PLACE[1] * arm.yaw_sign
    camera_s = 1e-3 * world.around(load_scene(name)).camera.latency_ms
    row: Row = {"world": world.name, "late_s": None, "true_late_s": camera_s + arm.stop_lag_s, "robot_s": 0.0}
    try:
        insertion = stage(Job(**job_in(world, name, 0, start, seed, **BEFORE_SIGNS, **job)), models_of(models))
        plans = slow_and_fast(insertion.state.plan, insertion.cell.scene.fps)
    except (PhysicsError, LimitError):
        return row
    series = list[Press]()
    try:
        whole = _all_pressed(insertion, plans, series)
    except PhysicsError:  # a grasp in between has no equilibrium
        whole = False
    known_s = late_s(series) if whole else None
    return row | {"late_s": known_s, "robot_s": insertion.seconds.total_s + trip_s(plans[0]) + GUIDANCE_S * len(series)}


def _all_pressed(insertion: Insertion, plans: Sequence[Plan], series: list[Press]) -> bool:
    """Add all presses to ``series``; False if one failed."""
    while (fast := next_is_fast(series)) is not None:
        afresh, insertion.grasps = not series, 1
        watch = _pressed(insertion, plans[fast])
        while hangs_askew(insertion):
            afresh, fast = True, False
            insertion.take_afresh(plans[fast])
            watch = _pressed(insertion, plans[fast])
        if insertion.state.phase is not Phase.PROBED:
            return False
        series.append(Press(fast=fast, stop=watch.stop, afresh=afresh))
    return True


def _pressed(insertion: Insertion, plan: Plan) -> StopWatch:
    watch = StopWatch()
    insertion.watches = watch.on_event
    insertion.begin_again(plan)
    insertion.run()
    return watch


def lateness(worlds: Sequence[World], objects: Mapping[str, Scene], seed: int, models: Path, workers: int) -> list[Row]:
    """`timed` in each world in which an object can be held, with the one that turns most about its first corner."""
    held = [(world, held_in(world, objects)) for world in worlds]
    cells = [(world, next(name for name in by_corner(objects) if name in held)) for world, held in held if held]
    return timed_each(cells, seed, models, workers)


def timed_each(cells: Sequence[tuple[World, str]], seed: int, models: Path, workers: int) -> list[Row]:
    """`timed` in each world, with the object named beside it."""
    todo = [partial(timed, world, name, hash_seed(seed, n), models) for n, (world, name) in enumerate(cells)]
    return list(shown("lateness of each world (simulated)", results(call, todo, workers, in_order=True), len(todo)))


def errors_ms(rows: Sequence[Row]) -> list[float]:
    """Measured less true lateness of each world in which it was measured."""
    return [1e3 * (row["late_s"] - row["true_late_s"]) for row in rows if row["late_s"] is not None]
