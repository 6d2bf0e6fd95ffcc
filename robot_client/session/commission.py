"""The first day of a cell: probes with known errors, first to check its wiring, then to learn from.

A probe is a guarded descent from a known error that ends with its first decision; nothing is inserted. All limits, the
motion lease and every fault of an insertion apply to it. Results are stored after each probe, so that an interrupted
commissioning resumes: at most the probe under way is lost.
"""

import asyncio
import hashlib
import json
import math
import os
import random
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple

from pydantic import Field, ValidationError

from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.state import Phase
from robot_client.ports import DriverError
from service.contract import wire
from service.contract.frames import Contract, ContractError, Finger, first_error
from service.contract.words.wiring import WIRINGS

SIDES = ((8.0, 8.0), (-8.0, -8.0), (8.0, -8.0), (-8.0, 8.0))
"""Errors of the wiring check: mm and deg. Straight above the edges, a yaw to either side looks alike."""
PRESSES = ((0.0, 15.0), (0.0, -15.0))
"""Errors of the presses that identify the gel: a turned object lies on both blocks and is pushed straight up."""
REACH = (15.0, 15.0)
"""Largest errors of probes to learn from: the training range of the released networks."""
FITS = (2.5, 3.0)
"""Approximate errors that insert: no probe begins there."""
CLEAR_SHARE = 0.2  # share of the known error below which estimates show no sign
LEAST_TURN_DEG, LIKE, LEAST_TURNS, ALIKE = 0.03, 0.5, 2, 0.5  # turns of similar size, and their share that follows x
WENT_IN_SIGMA_MM, UNSTATED_SIGMA = 1.5, 5.0
OFF_MM, OFF_DEG = 5.0, 8.0  # largest common offset of two opposite sides in a cell with a correct frame
WENT_IN = "went in without a touch"
RECORD = "commissioning.json"


class Probe(Contract):
    """One probe: its known error, and the service's result (``said`` if it gave no estimate).

    ``turns_deg``: turn of the object as seen by the left and the right finger, clockwise in their pictures.
    """

    x_mm: float
    theta_deg: float
    estimate_x_mm: float | None = None
    estimate_theta_deg: float | None = None
    sigma_x_mm: float | None = None
    sigma_theta_deg: float | None = None
    turns_deg: tuple[float, float] | None = None
    said: str = ""
    insertion_id: str


class Record(Contract):
    """A stored commissioning. ``seed`` determines the errors of all probes, ``named`` are mistakes of the cell.

    ``gels`` are those of its first probe, by the service's names. ``presses`` continued until the gel slid. ``sha256``
    covers all other fields as written.
    """

    version: Literal[1] = 1
    begun: str
    seed: int = Field(ge=0)
    object: str = ""
    gels: dict[Finger, str] = Field(default_factory=dict)
    signs: tuple[Probe, ...] = ()
    named: tuple[str, ...] = ()
    presses: tuple[Probe, ...] = ()
    probes: tuple[Probe, ...] = ()
    sha256: str = ""

    def digest(self) -> str:
        """SHA-256 of all other fields."""
        younger = {"presses"} if not self.presses else set()  # older records without presses keep their digest
        content = self.model_dump(mode="json", exclude={"sha256", *younger})
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


class Ended(NamedTuple):
    """How a probe ended: its stored form, the phase, the reason if it failed, and the service's gels."""

    probe: Probe
    phase: Phase
    reason: str
    gels: dict[Finger, str]


def commissioned(path: Path) -> Record:
    """The record of a cell that may insert; raises ContractError for an uncommissioned cell, or named mistakes."""
    record = read_record(path)
    if record is None or len(record.signs) < len(SIDES):
        raise ContractError(f"{path}: this cell was not commissioned to the end; run `commission --live`")
    if named := record.named or mistakes(record.signs):  # it may have been interrupted before they were written
        raise ContractError(f"{path} names mistakes; mend them and commission again: {'; '.join(named)}")
    return record


def read_record(path: Path) -> Record | None:
    """The record at ``path``, None if there is none yet; raises ContractError for any other file, or if edited."""
    try:
        record = Record.model_validate_json(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except OSError as error:
        raise ContractError(f"cannot read {path}: {error.strerror}") from None
    except ValidationError as error:
        raise ContractError(f"{path} is no record of a commissioning: {first_error(error)}") from None
    if record.sha256 != record.digest():
        raise ContractError(f"{path} is not as it was written: commission the cell again")
    return record


def keep_record(path: Path, record: Record) -> None:
    """Write it atomically, with its digest, so that a kill or a power cut leaves the previous record."""
    record = record.model_copy(update={"sha256": record.digest()})
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp")
    with temporary.open("w", encoding="utf-8") as file:
        file.write(json.dumps(record.model_dump(mode="json"), indent=1) + "\n")
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)


def mistakes(signs: tuple[Probe, ...]) -> tuple[str, ...]:
    """The likely mistakes of a cell from its answers to :data:`SIDES`; empty for a good one.

    Some gels do not feel the yaw: that is no mistake. Not feeling x, which turns every object, is one.
    """
    if wrong := [probe.said for probe in signs if probe.said.startswith("contradictory")]:
        return tuple(dict.fromkeys(wrong))
    if mirrored := _mirrored(signs):
        return (mirrored,)
    x = _axis([(probe.x_mm, *_felt_x(probe)) for probe in signs])
    theta = _axis([(probe.theta_deg, probe.estimate_theta_deg, probe.sigma_theta_deg) for probe in signs])
    if x is None or all(probe.estimate_x_mm is None for probe in signs):
        undecided = [probe.said for probe in signs if probe.said not in {"", WENT_IN}]
        felt_nothing = f"nothing was felt {SIDES[0][0]:g} mm beside the gap: is the block there, is its width right?"
        return tuple(dict.fromkeys(undecided)) or (felt_nothing,)
    causes = []
    if not x[0]:
        causes.append("opposite errors in x give like estimates: the gels do not feel the block")
    yaws = (theta[0],) if theta and theta[0] else (1, -1) if x[0] < 0 else (1,)  # an axis not felt may be either
    causes += [WIRINGS[x[0], yaw] for yaw in yaws if (x[0], yaw) in WIRINGS]
    if abs(x[1]) > OFF_MM:
        causes.append(f"the tool frame or the fixture is off by about {x[1]:+.1f} mm in x")
    if theta and abs(theta[1]) > OFF_DEG:
        causes.append(f"the tool frame or the fixture is off by about {theta[1]:+.1f} deg in yaw")
    return tuple(causes)


def _felt_x(probe: Probe) -> tuple[float | None, float | None]:
    """Estimate and sigma of x; the error of an inserted probe was within the gap's clearance."""
    if probe.said == WENT_IN:
        return 0.0, WENT_IN_SIGMA_MM
    return probe.estimate_x_mm, probe.sigma_x_mm


def _axis(felt: list[tuple[float, float | None, float | None]]) -> tuple[int, float] | None:
    """Sign (0 if unclear) and offset of (error, felt, sigma); None if a side gives no answer."""
    sides: dict[bool, list[tuple[float, float]]] = {True: [], False: []}
    for error, value, sigma in felt:
        if value is not None:
            sides[error > 0.0].append((value, (sigma or UNSTATED_SIGMA) ** -2.0))
    if not all(sides.values()):
        return None
    means = [sum(value for value, _ in side) / len(side) for side in sides.values()]
    signed = sum(value * weight * (1.0 if up else -1.0) for up, side in sides.items() for value, weight in side)
    share = signed / (abs(felt[0][0]) * sum(weight for side in sides.values() for _, weight in side))
    return (0 if abs(share) <= CLEAR_SHARE else 1 if share > 0 else -1), 0.5 * sum(means)


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


def errors(seed: int, x_mm: float, theta_deg: float, fits: tuple[float, float]) -> Callable[[int], tuple[float, float]]:
    """Known error of probe ``number``, uniform within +-x_mm and +-theta_deg except for errors that fit the gap."""
    fits = min(fits[0], 0.5 * x_mm), min(fits[1], 0.5 * theta_deg)

    def of(number: int) -> tuple[float, float]:
        drawn = random.Random(f"{seed}/{number}")
        while True:
            x, theta = drawn.uniform(-x_mm, x_mm), drawn.uniform(-theta_deg, theta_deg)
            if abs(x) > fits[0] or abs(theta) > fits[1]:
                return round(x, 2), round(theta, 2)

    return of


@dataclass(slots=True)
class Commissioning:
    """Carries out the commissioning. ``probe`` is one probe from the arm's present pose, ``fetch`` regrasps the object.

    ``press`` is a probe that goes on until the gel slides; None: no presses. ``path`` is the record's; its probes are
    not repeated.
    """

    path: Path
    record: Record
    probe: Callable[[float, float], Awaitable[Ended]]
    fetch: Callable[[], Awaitable[None]]
    draw: Callable[[int], tuple[float, float]]
    show: Callable[[str], None]
    press: Callable[[float, float], Awaitable[Ended]] | None = None
    _began_s: float = field(default_factory=time.monotonic)

    async def run(self, probes_n: int) -> Record:
        """Wiring check first; if it fails nothing else is done. Raises DriverError if the cell fails or is stopped."""
        try:
            while len(self.record.signs) < len(SIDES):
                number = len(self.record.signs)
                done = await self._probe(f"sign {number + 1} of {len(SIDES)}", *SIDES[number])
                self._keep(signs=(*self.record.signs, done))
            self._keep(named=mistakes(self.record.signs))
            while self.press and not self.record.named and len(self.record.presses) < len(PRESSES):
                number = len(self.record.presses)
                title = f"press {number + 1} of {len(PRESSES)}"
                done = await self._probe(title, *PRESSES[number], self.press)
                self._keep(presses=(*self.record.presses, done))
            while not self.record.named and len(self.record.probes) < probes_n:
                number = len(self.record.probes)
                done = await self._probe(f"probe {number + 1} of {probes_n}{self._left(probes_n)}", *self.draw(number))
                self._keep(probes=(*self.record.probes, done))
        except asyncio.CancelledError:
            raise DriverError(
                "operator: interrupted between two probes, nothing moves; run it again to go on"
            ) from None
        return self.record

    async def _probe(
        self, title: str, x_mm: float, theta_deg: float, how: Callable[[float, float], Awaitable[Ended]] | None = None
    ) -> Probe:
        await self.fetch()  # each time: it drifts in the hand, and open gels are learnt before a grasp
        done, phase, reason, gels = await (how or self.probe)(x_mm, theta_deg)
        if phase is not Phase.PROBED:
            raise DriverError(f"{title}: {reason}")
        if gels != (self.record.gels or gels):
            raise DriverError(f"{title}: a gel was changed or calibrated again; remove {self.path} and begin anew")
        self.record = self.record.model_copy(update={"gels": gels})
        felt = done.said
        if done.estimate_x_mm is not None and done.estimate_theta_deg is not None:
            felt = f"felt {done.estimate_x_mm:+.1f} mm, {done.estimate_theta_deg:+.1f} deg"
        self.show(f"{title}: {x_mm:+.1f} mm, {theta_deg:+.1f} deg; {felt}")
        return done

    def _left(self, probes_n: int) -> str:
        done_n = len(self.record.probes) + len(self.record.signs)
        if done_n <= len(SIDES):
            return ""
        left_s = (time.monotonic() - self._began_s) / done_n * (probes_n + len(SIDES) - done_n)
        return f", {left_s / 60.0:.0f} min left" if left_s > 90.0 else ""

    def _keep(self, **changed: object) -> None:
        self.record = self.record.model_copy(update=changed)
        keep_record(self.path, self.record)


def probe_of(plan_id: str, approach: WorkPose, answer: wire.Correction | None, ending: str) -> Probe:
    """A probe in its stored form; ``ending`` is how it ended without an answer."""
    probe = Probe(x_mm=approach.x_mm, theta_deg=approach.yaw_deg, said=ending, insertion_id=plan_id)
    if answer is None:
        return probe
    felt = answer.estimate
    estimate = {"estimate_x_mm": felt.dx_mm, "estimate_theta_deg": felt.dtheta_deg}
    sigma = {"sigma_x_mm": felt.sigma_x_mm, "sigma_theta_deg": felt.sigma_theta_deg}
    return probe.model_copy(update={**estimate, **sigma, "turns_deg": answer.turns_deg, "said": ""})
