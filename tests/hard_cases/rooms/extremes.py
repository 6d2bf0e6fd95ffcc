"""Finite extremes: the largest and smallest numbers there are give finite results, or are refused by name."""

import math
from dataclasses import fields, is_dataclass

import numpy as np

from robot_client.insertion.geometry import CellFrame, Pose, WorkPose, multiply, normalised, rotate, turn_quaternion
from robot_client.insertion.profile import plan_profile
from service.decision.belief import BeliefGrid
from service.decision.controllers import axis_command, make_controller
from service.decision.evidence import from_joint, from_pair, softmax
from tests.hard_cases.instead import blind
from tests.hard_cases.registry import Guard, case
from tests.hard_cases.rooms.decision import LIMITS, _cards, evidence_for
from tests.hard_cases.rooms.doors import Door
from tests.hard_cases.rooms.motion import pose

EXTREMES = (1e308, -1e308, 1e150, 1e-308, 5e-324, 0.0)


def numbers(result: object) -> list[float]:
    """Every number inside a function's result."""
    if isinstance(result, bool | str | bytes | type(None)):
        return []
    if isinstance(result, int | float | np.number):
        return [float(result)]
    if isinstance(result, np.ndarray):
        return np.asarray(result, float).ravel().tolist() if result.dtype.kind in "fiu" else []
    if isinstance(result, tuple | list):
        return [number for part in result for number in numbers(part)]
    if isinstance(result, WorkPose):
        return numbers(list(result.model_dump().values()))
    return (
        [number for part in fields(result) for number in numbers(getattr(result, part.name))]
        if is_dataclass(result)
        else []
    )


def spilled(doors: list[Door]) -> float:
    """How many numbers that are not finite come out for the largest and smallest finite ones (refusals are answers)."""
    spilt = 0.0
    for door in doors:
        for value in EXTREMES:
            try:
                with np.errstate(all="ignore"):
                    spilt += sum(not math.isfinite(number) for number in numbers(door(value)))
            except ValueError:
                continue
    return spilt


@case(
    "motion",
    why="the largest double plus itself is infinite, and so is one over the smallest",
    holds="finite extremes give finite results or are refused by name: non-finite numbers",
    guard=Guard("robot_client.insertion.geometry:multiply", "every number counts as finite", blind),
)
def extremes_in_the_robot_client(_seed: int) -> float:
    def profile(length: float, speed: float) -> list[float]:
        planned = plan_profile(length, speed, 1.0, 1.0)
        return [planned.duration_s, *(planned.position(share * planned.duration_s) for share in (0.0, 0.5, 1.0))]

    return spilled(
        [
            lambda v: multiply((v, v, 0.0, 0.0), (v, 1.0, 0.0, 0.0)),
            lambda v: rotate((1.0, 0.0, 0.0, 0.0), (v, v, v)),
            lambda v: normalised((v, 0.0, 0.0, 1.0)),
            turn_quaternion,
            lambda v: CellFrame(origin_mm=(v, 0.0, 0.0)).to_controller(pose(x=1e5)),
            lambda v: CellFrame(origin_mm=(-v, 0.0, 0.0)).from_controller(Pose(v, v, v)),
            lambda v: pose(x=v).distance_mm(pose(x=-v)),
            lambda v: pose(x=v).towards(pose(x=-v), 0.5),
            lambda v: profile(abs(v), 1.0),
            lambda v: profile(1.0, abs(v)),
        ]
    )


@case(
    "decision",
    why="a belief shifted by 1e308 mm, or given an error of that size, has no cell left that explains it",
    holds="finite extremes give finite results or are refused by name: non-finite numbers",
    guard=Guard("service.decision.belief:OUTLIER_SHARE", "every estimate belongs to the object", 0.0),
)
def extremes_in_the_decision(_seed: int) -> float:
    direction, magnitude, joint = _cards()
    diagonal = np.eye(len(joint.grid_x_mm), len(joint.grid_theta_deg), dtype=bool)

    def belief(value: float) -> object:
        grid = BeliefGrid()
        grid.move(value, -value)
        grid.absorb(evidence_for("5", (value, 1.0), (max(abs(value), 1e-300), 1.0)))
        return [*grid.best_move(), grid.probability]

    def pair(value: float) -> object:
        moments = {"error": np.full((1, 2), value), "log_sigma": np.zeros((1, 2))}
        evidence = from_pair(direction, magnitude, {"logits": np.full((1, 9), value)}, moments)
        return [evidence.probabilities, evidence.error, evidence.sigma]

    def density(value: float) -> object:
        evidence = from_joint(joint, {"log_density": np.where(diagonal, value, 0.0)[None]})
        return [evidence.probabilities, evidence.error, evidence.sigma]

    return spilled(
        [
            lambda v: axis_command(1, v, first=True),
            lambda v: softmax(np.array([v, 1.0])),
            pair,
            density,
            belief,
            lambda v: make_controller("heuristic", LIMITS).decide(evidence_for("5", (v, v)), 1),
            lambda v: make_controller("belief", LIMITS).decide(evidence_for("5", (v, 1.0)), 1),
        ]
    )
