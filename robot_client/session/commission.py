"""The first day of a cell: probes whose error is known, first to see that it is wired as it says, then to learn from.

A probe is a guarded descent from a known error that ends with its first decision; nothing is inserted. All limits, the
motion lease and every fault of an insertion hold for it. What was seen is kept after each probe, so that an interrupted
commissioning goes on where it was: at most the probe under way is lost.
"""

import asyncio
import json
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
from service.contract.frames import Contract, ContractError, Finger, first_error
from service.contract.words.wiring import WIRINGS

SIDES = ((8.0, 0.0), (-8.0, 0.0), (0.0, 8.0), (0.0, -8.0))
"""Where the cell is asked for signs: mm and deg."""
CLEAR_SHARES = (0.3, 0.1)  # of the way between two sides, below which estimates show no sign; yaw is felt too small
OFF_MM, OFF_DEG = 5.0, 8.0  # what two opposite sides may be off by together in a cell that is framed right
WENT_IN = "went in without a touch"
RECORD = "commissioning.json"


class Probe(Contract):
    """One probe: its known error, and what the service made of it (``said`` where it gave no estimate)."""

    x_mm: float
    theta_deg: float
    estimate_x_mm: float | None = None
    estimate_theta_deg: float | None = None
    said: str = ""
    insertion_id: str


class Record(Contract):
    """A commissioning as it is kept. ``seed`` decides the errors of all probes, ``named`` are mistakes of the cell.

    ``gels`` are those of its first probe, as the service names them.
    """

    version: Literal[1] = 1
    begun: str
    seed: int = Field(ge=0)
    object: str = ""
    gels: dict[Finger, str] = Field(default_factory=dict)
    signs: tuple[Probe, ...] = ()
    named: tuple[str, ...] = ()
    probes: tuple[Probe, ...] = ()


class Ended(NamedTuple):
    """How a probe ended: what is kept of it, the phase, why if not as it should, and the gels that the service has."""

    probe: Probe
    phase: Phase
    reason: str
    gels: dict[Finger, str]


def commissioned(path: Path) -> Record:
    """The record of a cell that may insert; raises ContractError where it was not commissioned, or named mistakes."""
    record = read_record(path)
    if record is None or len(record.signs) < len(SIDES):
        raise ContractError(f"{path}: this cell was not commissioned to the end; run `commission --live`")
    if named := record.named or mistakes(record.signs):  # it may have been broken off before they were written
        raise ContractError(f"{path} names mistakes; mend them and commission again: {'; '.join(named)}")
    return record


def read_record(path: Path) -> Record | None:
    """The record at ``path``, None where there is none yet; raises ContractError for anything else."""
    try:
        return Record.model_validate_json(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except OSError as error:
        raise ContractError(f"cannot read {path}: {error.strerror}") from None
    except ValidationError as error:
        raise ContractError(f"{path} is no record of a commissioning: {first_error(error)}") from None


def keep_record(path: Path, record: Record) -> None:
    """Write it whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp")
    temporary.write_text(json.dumps(record.model_dump(mode="json"), indent=1) + "\n", encoding="utf-8")
    temporary.replace(path)


def mistakes(signs: tuple[Probe, ...]) -> tuple[str, ...]:
    """What is likely wrong with a cell that answered :data:`SIDES` so; nothing in a good one.

    An axis with a side that went in, or was not decided, says nothing: a short object fits at any yaw. Of x, which
    matters for every object, nothing is a mistake, too.
    """
    if wrong := [probe.said for probe in signs if probe.said.startswith("contradictory")]:
        return tuple(dict.fromkeys(wrong))
    x = _axis([probe.estimate_x_mm for probe in signs[:2]], SIDES[0][0], CLEAR_SHARES[0])
    theta = _axis([probe.estimate_theta_deg for probe in signs[2:]], SIDES[2][1], CLEAR_SHARES[1])
    if x is None:
        undecided = [probe.said for probe in signs[:2] if probe.estimate_x_mm is None and probe.said != WENT_IN]
        felt_nothing = f"nothing was felt {SIDES[0][0]:g} mm beside the gap: is the block there, is its width right?"
        return tuple(dict.fromkeys(undecided)) or (felt_nothing,)
    found = []
    unclear = [name for name, axis in (("x", x), ("yaw", theta)) if axis and not axis[0]]
    if unclear:
        found.append(f"opposite errors in {' and '.join(unclear)} give like estimates: the gels do not feel the block")
    elif (key := (x[0], theta[0] if theta else 1)) in WIRINGS:
        found.append(WIRINGS[key])
    if abs(x[1]) > OFF_MM:
        found.append(f"the tool frame or the fixture is off by about {x[1]:+.1f} mm in x")
    if theta and abs(theta[1]) > OFF_DEG:
        found.append(f"the tool frame or the fixture is off by about {theta[1]:+.1f} deg in yaw")
    return tuple(found)


def _axis(felt: list[float | None], side: float, clear_share: float) -> tuple[int, float] | None:
    """Sign (0 where it is not clear) and offset of what was felt at +side and -side; None where either went in."""
    plus, minus = felt
    if plus is None or minus is None:
        return None
    share = (plus - minus) / (2.0 * side)
    return (0 if abs(share) <= clear_share else 1 if share > 0 else -1), 0.5 * (plus + minus)


def errors(seed: int, x_mm: float, theta_deg: float, fits: tuple[float, float]) -> Callable[[int], tuple[float, float]]:
    """Known errors, uniform within +-x_mm and +-theta_deg but for those that fit the gap: of probe ``number``."""

    def of(number: int) -> tuple[float, float]:
        drawn = random.Random(f"{seed}/{number}")
        while True:
            x, theta = drawn.uniform(-x_mm, x_mm), drawn.uniform(-theta_deg, theta_deg)
            if abs(x) > fits[0] or abs(theta) > fits[1]:
                return round(x, 2), round(theta, 2)

    return of


@dataclass(slots=True)
class Commissioning:
    """Carries it out. ``probe`` is one probe from wherever the arm stands, ``fetch`` puts the object back and takes it.

    ``path`` is the record's; what it holds already is not done again.
    """

    path: Path
    record: Record
    probe: Callable[[float, float], Awaitable[Ended]]
    fetch: Callable[[], Awaitable[None]]
    draw: Callable[[int], tuple[float, float]]
    show: Callable[[str], None]
    _began_s: float = field(default_factory=time.monotonic)

    async def run(self, probes_n: int) -> Record:
        """Signs first; where they are wrong nothing goes on. Raises DriverError where the cell fails or is stopped."""
        try:
            while len(self.record.signs) < len(SIDES):
                number = len(self.record.signs)
                done = await self._probe(f"sign {number + 1} of {len(SIDES)}", *SIDES[number])
                self._keep(signs=(*self.record.signs, done))
            self._keep(named=mistakes(self.record.signs))
            while not self.record.named and len(self.record.probes) < probes_n:
                number = len(self.record.probes)
                done = await self._probe(f"probe {number + 1} of {probes_n}{self._left(probes_n)}", *self.draw(number))
                self._keep(probes=(*self.record.probes, done))
        except asyncio.CancelledError:
            raise DriverError(
                "operator: interrupted between two probes, nothing moves; run it again to go on"
            ) from None
        return self.record

    async def _probe(self, title: str, x_mm: float, theta_deg: float) -> Probe:
        await self.fetch()  # each time: it drifts in the hand, and open gels are learnt before a grasp
        done, phase, reason, gels = await self.probe(x_mm, theta_deg)
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


def probe_of(plan_id: str, approach: WorkPose, felt: tuple[float, float] | None, said: str) -> Probe:
    """A probe as it is kept."""
    x, theta = felt or (None, None)
    known = {"x_mm": approach.x_mm, "theta_deg": approach.yaw_deg}
    return Probe(**known, estimate_x_mm=x, estimate_theta_deg=theta, said=said, insertion_id=plan_id)
