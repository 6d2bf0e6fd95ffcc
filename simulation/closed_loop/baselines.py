"""What decides the next move in a closed-loop evaluation: the service's controllers, and baselines beside them.

A baseline is a `Chooser`: it is asked after every blocked attempt and its move replaces the service's. What it may
look at is in `View`; its docstring states what it takes from there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from service.contract.wire import Correction, Estimate, NoDecision

Move = tuple[float, float]
SIGNS: Mapping[str, tuple[int, int]] = {
    "1": (-1, 0), "2": (1, 0), "3": (-1, 1), "4": (-1, -1), "5": (1, 1),
    "6": (1, -1), "7": (0, -1), "8": (0, 1), "near": (0, 0),
}  # fmt: skip
CLIP_LATER = 4.0  # Eq. 1: |C| after the first trial, mm or deg
GAIN = 0.7  # Eq. 1
TORQUE_NOISE_N_MM, FORCE_NOISE_N = 5.0, 0.1  # resolution of a small wrist sensor


@dataclass(frozen=True, slots=True)
class View:
    """What a baseline may look at after attempt number ``attempt`` was blocked.

    ``error`` is the truth (x mm, theta deg) before the attempt, for the oracle alone. ``wrench`` [6] N and N mm on the
    object at the TCP in the hand frame, of the contact alone: the sensor is tared before each descent, with the object
    hanging free. ``classes`` and ``estimate`` are the networks', None where they are not used.
    """

    attempt: int
    error: Move
    wrench: NDArray[np.float64]
    gap_mm: float
    grasp_height_mm: float
    classes: Mapping[str, float] | None = None
    estimate: Move | None = None


class Chooser(Protocol):
    """Decides in the service's place, for one insertion."""

    def choose(self, view: View) -> Move:
        """The move (mm, deg) to add to the object's pose."""


class Oracle:
    """Moves by the true error: what is left is the first attempt and the creep in the hand."""

    def choose(self, view: View) -> Move:
        """Undo the error."""
        return -view.error[0], -view.error[1]


@dataclass(slots=True)
class Search:
    """Visits guesses of the first error one after the other, whatever is felt. ``guesses`` [n, 2]: (mm, deg)."""

    guesses: NDArray[np.float64]
    at: int = 0

    def choose(self, view: View) -> Move:  # noqa: ARG002 (blind: that is the point)
        """From the guess under trial to the next one; the first trial is the guess "no error"."""
        before = self.guesses[self.at - 1] if self.at else np.zeros(2)
        step = before - self.guesses[self.at % len(self.guesses)]
        self.at += 1
        return float(step[0]), float(step[1])


def random_search(seed: int, reach: Move) -> Search:
    """Guesses uniform in the range of errors."""
    rng = np.random.default_rng((seed, 0xA11))
    return Search(rng.uniform(-1.0, 1.0, (15, 2)) * reach)


def blind_grid(_: int, reach: Move) -> Search:
    """A grid as wide as a 2.5 mm clearance asks for, nearest cells first."""
    x = 4.5 * np.arange(-math.ceil(reach[0] / 4.5), math.ceil(reach[0] / 4.5) + 1)
    theta = 6.0 * np.arange(-math.ceil(reach[1] / 6.0), math.ceil(reach[1] / 6.0) + 1)
    cells = np.stack(np.meshgrid(x, theta, indexing="ij"), -1).reshape(-1, 2)
    away = np.max(np.abs(cells) / reach, axis=1)
    inside = (away > 0.0) & (away <= 1.0)
    return Search(cells[inside][np.argsort(away[inside], kind="stable")])


def spiral_search(_: int, reach: Move) -> Search:
    """An Archimedean spiral outwards, 4.5 mm (6 deg) between its turns and between its points."""
    points: list[tuple[float, float]] = []
    angle = 0.0
    while len(points) < 60:
        angle += 2.0 * math.pi / max(1.0, angle)
        points.append((angle * math.cos(angle), angle * math.sin(angle)))
    spiral = np.array(points) / (2.0 * math.pi) * (4.5, 6.0)
    return Search(spiral[np.all(np.abs(spiral) <= reach, axis=1)])


@dataclass(slots=True)
class DirectionOnly:
    """Only the most probable class: steps of a fixed size against its signs, halved where a sign turns over."""

    step: list[float] = field(default_factory=lambda: [8.0, 8.0])
    last: list[int] = field(default_factory=lambda: [0, 0])

    def choose(self, view: View) -> Move:
        """Bisection by signs, axis by axis."""
        if not view.classes:
            return 0.0, 0.0
        signs = SIGNS[max(view.classes, key=lambda name: view.classes[name] if view.classes else 0.0)]
        move = [0.0, 0.0]
        for axis, sign in enumerate(signs):
            if sign and sign == -self.last[axis]:
                self.step[axis] = max(1.5, 0.5 * self.step[axis])
            self.last[axis] = sign or self.last[axis]
            move[axis] = -sign * self.step[axis]
        return move[0], move[1]


class MagnitudeOnly:
    """Only the estimated error: Eq. 1 as if the direction always agreed."""

    def choose(self, view: View) -> Move:
        """-0.7 of the estimate, at most 4 mm and deg after the first trial."""
        return damped(view.estimate or (0.0, 0.0), view.attempt)


@dataclass(slots=True)
class ForceOnly:
    """Only the wrist's force and torque: where the block presses gives x exactly, and theta by the side it leans to.

    The pivot is a block's edge, G/2 from the gap's centre whatever the shape, so x = +-G/2 minus the lever arm. Yaw
    follows from where along the edge the force acts, by `YAW_DEG_PER_MM`. The sensor's noise is added.
    """

    rng: np.random.Generator

    def choose(self, view: View) -> Move:
        """-0.7 of what the lever arms say, at most 4 mm and deg after the first trial."""
        noise = np.repeat([FORCE_NOISE_N, TORQUE_NOISE_N_MM], 3)
        lever = lever_arms_mm(view.wrench + self.rng.normal(size=6) * noise, view.grasp_height_mm)
        return damped(error_from_levers(lever, view.gap_mm), view.attempt)


# deg of yaw for each mm that the force acts along the edge, away from the middle. Least squares over 793 blocked
# attempts of the training objects gives 0.29 (correlation 0.75); a little less swings less
YAW_DEG_PER_MM = 0.25
BOTH_SIDES_MM = 8.0  # a shorter lever means that both blocks carry: then x is small


def lever_arms_mm(wrench: NDArray[np.float64], grasp_height_mm: float) -> Move:
    """Where the vertical force acts at the object's bottom, (across, along) the gap in mm from the hand's axis."""
    fx, fy, fz, tx, ty, _ = wrench
    if not abs(fz) > 1e-3:
        return 0.0, 0.0
    z = -grasp_height_mm
    return float((z * fx - ty) / fz), float((tx + z * fy) / fz)


def error_from_levers(lever: Move, gap_mm: float) -> Move:
    """(x mm, theta deg) that explain the lever arms."""
    across, along = lever
    side = math.copysign(1.0, across)
    x = 0.0 if abs(across) < BOTH_SIDES_MM else side * 0.5 * gap_mm - across
    return float(np.clip(x, -20.0, 20.0)), float(np.clip(-side * YAW_DEG_PER_MM * along, -15.0, 15.0))


def damped(estimate: Move, attempt: int) -> Move:
    """Eq. 1 where nothing contradicts: 0.7 of the estimate, clipped after the first trial."""
    move = -GAIN * np.asarray(estimate, float)
    if attempt > 1:
        move = np.clip(move, -CLIP_LATER, CLIP_LATER)
    return float(move[0]), float(move[1])


Make = Callable[[int, Move], Chooser]
"""(seed, (x range mm, theta range deg)) -> a chooser for one insertion."""


@dataclass(frozen=True, slots=True)
class Controller:
    """One row of the table: the service's own controller, or a baseline that is made for each insertion.

    ``folder``: its networks, inside the folder of models.
    """

    title: str
    service_controller: Literal["belief", "heuristic"] = "belief"
    folder: str = "."
    uses_networks: bool = True
    make: Make | None = None


def empty_correction(refused: NoDecision) -> Correction:
    """What a baseline's move is put into where the service had none to give."""
    return Correction(
        insertion_id=refused.insertion_id,
        attempt=refused.attempt,
        dx_mm=0.0,
        dtheta_deg=0.0,
        class_probabilities={},
        estimate=Estimate(dx_mm=0.0, dtheta_deg=0.0),
        confidence=0.0,
        controller="heuristic",
        reason="",
        latency_ms={},
    )


CONTROLLERS: Mapping[str, Controller] = {
    "belief": Controller("belief, our networks"),
    "joint": Controller("belief, joint density", folder="joint"),
    "heuristic": Controller("the paper's heuristic, our networks", service_controller="heuristic"),
    "paper": Controller("the paper's heuristic, the paper's recipe", service_controller="heuristic", folder="paper"),
    "direction": Controller("direction only", make=lambda *_: DirectionOnly()),
    "magnitude": Controller("magnitude only", make=lambda *_: MagnitudeOnly()),
    "force": Controller(
        "force/torque only", uses_networks=False, make=lambda seed, _: ForceOnly(np.random.default_rng((seed, 0xF)))
    ),
    "oracle": Controller("oracle step", uses_networks=False, make=lambda *_: Oracle()),
    "grid": Controller("blind grid", uses_networks=False, make=blind_grid),
    "spiral": Controller("spiral search", uses_networks=False, make=spiral_search),
    "random": Controller("random search", uses_networks=False, make=random_search),
}
