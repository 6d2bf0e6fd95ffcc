"""The wiring check of a new cell: four probes with known errors, and which mistakes their answers name."""

import math

from robot_client.insertion.geometry import WorkPose
from service.contract import wire
from service.contract.frames import Contract
from service.contract.words.wiring import WIRINGS

SIDES = ((8.0, 8.0), (-8.0, -8.0), (8.0, -8.0), (-8.0, 8.0))
"""Errors of the wiring check: mm and deg. Straight above the edges, a yaw to either side looks alike."""
CLEAR_SHARE = 0.2  # share of the known error below which estimates show no sign
CLEAR_ODDS = 200.0  # to one, by their own sigmas, of a sign of the yaw, which narrow and round parts hardly feel
LEAST_TURN_DEG, LIKE, LEAST_TURNS, ALIKE = 0.08, 0.5, 2, 0.5  # turns of similar size, and their share that follows x
WENT_IN_SIGMA_MM, UNSTATED_SIGMA = 1.5, 5.0
OFF_MM, OFF_DEG = 5.0, 8.0  # largest common offset of two opposite sides in a cell with a correct frame
LOW_MM = 3.0  # what is late makes a touch seem up to 2 mm lower; from 4.5 mm on, full depth ends short
WENT_IN = "went in without a touch"


class Probe(Contract):
    """One probe: its known error, and the service's result (``said`` if it gave no estimate).

    ``turns_deg``: turn of the object as seen by the left and the right finger, clockwise in their pictures.
    ``below_mm``: how far below the taught tops of the blocks it touched, as it seems; what is late makes it more,
    by the way in that time at ``touch_mm_s``, the speed of that touch.
    ``grip_n`` and ``slid_mm``, of a press until slip: the set force of the fingers, None if it cannot be set; and how
    far it had pressed when the gel slid, None if it did not or no contact is known.
    """

    x_mm: float
    theta_deg: float
    estimate_x_mm: float | None = None
    estimate_theta_deg: float | None = None
    sigma_x_mm: float | None = None
    sigma_theta_deg: float | None = None
    turns_deg: tuple[float, float] | None = None
    below_mm: float | None = None
    touch_mm_s: float | None = None
    grip_n: float | None = None
    slid_mm: float | None = None
    said: str = ""
    insertion_id: str


def mistakes(signs: tuple[Probe, ...]) -> tuple[str, ...]:
    """The likely mistakes of a cell from its answers to :data:`SIDES`; empty for a good one.

    Some gels do not feel the yaw: that is no mistake. Not feeling x, which turns every object, is one.
    """
    if contradictory := _contradictory(signs):
        return contradictory
    x, theta = _axes(signs)
    if x is None:
        undecided = [probe.said for probe in signs if probe.said not in {"", WENT_IN}]
        felt_nothing = f"nothing was felt {SIDES[0][0]:g} mm beside the gap: is the block there, is its width right?"
        return tuple(dict.fromkeys(undecided)) or (felt_nothing,)
    causes = []
    if not x[0]:
        causes.append("opposite errors in x give like estimates: the gels do not feel the block")
    causes += _reversed(x, theta)
    if abs(x[1]) > OFF_MM:
        causes.append(f"the tool frame or the fixture is off by about {x[1]:+.1f} mm in x")
    if theta and abs(theta[1]) > OFF_DEG:
        causes.append(f"the tool frame or the fixture is off by about {theta[1]:+.1f} deg in yaw")
    return (*causes, *_too_low(signs))


def dangerous_mistakes(signs: tuple[Probe, ...]) -> tuple[str, ...]:
    """Those of :func:`mistakes` by which corrections or claims are wrong: wiring, and the height of the blocks."""
    x, theta = _axes(signs)
    return _contradictory(signs) or ((*_reversed(x, theta), *_too_low(signs)) if x else ())


Axis = tuple[int, float]  # sign (0 if unclear) and offset


def _contradictory(signs: tuple[Probe, ...]) -> tuple[str, ...]:
    said = [probe.said for probe in signs if probe.said.startswith("contradictory")]
    return tuple(dict.fromkeys(said or filter(None, [_mirrored(signs)])))


def _axes(signs: tuple[Probe, ...]) -> tuple[Axis | None, Axis | None]:
    """Those of x and yaw; None for an axis with a side that gives no answer."""
    if all(probe.estimate_x_mm is None for probe in signs):
        return None, None
    x = _axis([(probe.x_mm, *_felt_x(probe)) for probe in signs])
    theta = [(probe.theta_deg, probe.estimate_theta_deg, probe.sigma_theta_deg) for probe in signs]
    return x, _axis(theta, CLEAR_ODDS)


def _reversed(x: Axis, theta: Axis | None) -> tuple[str, ...]:
    yaws = (theta[0],) if theta and theta[0] else (1, -1) if x[0] < 0 else (1,)  # an axis not felt may be either
    return tuple(WIRINGS[x[0], yaw] for yaw in yaws if (x[0], yaw) in WIRINGS)


def _too_low(signs: tuple[Probe, ...]) -> tuple[str, ...]:
    """Blocks whose tops are lower than taught: full depth would end short of the depth that is wanted."""
    below_mm = min((probe.below_mm for probe in signs if probe.below_mm is not None), default=0.0)
    if below_mm <= LOW_MM:
        return ()
    low = f"the block tops are up to {below_mm:.1f} mm lower than taught"
    return (f"{low}, or the object hangs so much higher, or the pictures come late",)


def _felt_x(probe: Probe) -> tuple[float | None, float | None]:
    """Estimate and sigma of x; the error of an inserted probe was within the gap's clearance."""
    if probe.said == WENT_IN:
        return 0.0, WENT_IN_SIGMA_MM
    return probe.estimate_x_mm, probe.sigma_x_mm


def _axis(felt: list[tuple[float, float | None, float | None]], odds: float = 1.0) -> Axis | None:
    """Sign and offset of (error, felt, sigma); None if a side gives no answer.

    ``odds``: of a sign, against the other one. An estimate is the mean of a normal posterior; whatever its prior around
    0 was, an error of either sign is exp(2 error felt / sigma^2) times as likely as its opposite.
    """
    sides: dict[bool, list[tuple[float, float]]] = {True: [], False: []}
    for error, value, sigma in felt:
        if value is not None:
            sides[error > 0.0].append((value, (sigma or UNSTATED_SIGMA) ** -2.0))
    if not all(sides.values()):
        return None
    means = [sum(value for value, _ in side) / len(side) for side in sides.values()]
    signed = sum(value * weight * (1.0 if up else -1.0) for up, side in sides.items() for value, weight in side)
    error = abs(felt[0][0])
    share = signed / (error * sum(weight for side in sides.values() for _, weight in side))
    unclear = abs(share) <= CLEAR_SHARE or 2.0 * error * abs(signed) < math.log(odds)
    return (0 if unclear else 1 if share > 0 else -1), 0.5 * sum(means)


def _mirrored(signs: tuple[Probe, ...]) -> str:
    """The mirrored picture, if there is one; facing each other, the fingers must see opposite turns.

    A block that pushes up at +x turns the object anticlockwise as seen by the left finger. Turns of different size do
    not belong to one rigid object: with a narrow contact, too few markers move with it.
    """
    turns = [(math.copysign(1.0, probe.x_mm), probe.turns_deg) for probe in signs if probe.turns_deg]
    turns = [
        (side, turn) for side, turn in turns if min(map(abs, turn)) > max(LEAST_TURN_DEG, LIKE * max(map(abs, turn)))
    ]
    if len(turns) < LEAST_TURNS:
        return ""
    with_x = [sum(side * turn[index] for side, turn in turns) for index in range(2)]
    total = [sum(abs(turn[index]) for _, turn in turns) for index in range(2)]
    if with_x[0] * with_x[1] <= 0.0 or any(abs(x) < ALIKE * all_ for x, all_ in zip(with_x, total, strict=True)):
        return ""
    finger = "left" if with_x[0] > 0.0 else "right"
    return f"both fingers see the object turn the same way: the {finger} picture is mirrored"


def probe_of(plan_id: str, approach: WorkPose, answer: wire.Correction | wire.NoDecision | None) -> Probe:
    """A probe in its stored form; without an ``answer`` it went in."""
    probe = Probe(x_mm=approach.x_mm, theta_deg=approach.yaw_deg, said=WENT_IN, insertion_id=plan_id)
    if answer is None:
        return probe
    if isinstance(answer, wire.NoDecision):
        said = f"{answer.reason}: {answer.detail}"
        return probe.model_copy(update={"said": said, "turns_deg": answer.turns_deg})
    felt = answer.estimate
    estimate = {"estimate_x_mm": felt.dx_mm, "estimate_theta_deg": felt.dtheta_deg}
    sigma = {"sigma_x_mm": felt.sigma_x_mm, "sigma_theta_deg": felt.sigma_theta_deg}
    return probe.model_copy(update={**estimate, **sigma, "turns_deg": answer.turns_deg, "said": ""})
