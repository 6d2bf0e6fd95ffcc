"""The first day of a cell: probes with known errors, to check its wiring and timing, then to learn from.

A probe is a guarded descent from a known error that ends with its first decision; nothing is inserted. All limits, the
motion lease and every fault of an insertion apply to it. Results are stored after each probe, so that an interrupted
commissioning resumes: at most the probe under way is lost, or the series of presses that tells the timing.
"""

import asyncio
import random
import time
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import count, islice
from pathlib import Path
from typing import NamedTuple

from robot_client.insertion.limits import LimitError
from robot_client.insertion.state import REFUSED, Phase
from robot_client.ports import DriverError
from robot_client.session.commission.answers import Answered, in_words
from robot_client.session.commission.lateness import PLACE, Press, late_s, next_is_fast
from robot_client.session.commission.record import Record, keep_record, keep_text
from robot_client.session.commission.wiring import SIDES, Probe, mistakes
from robot_client.session.stops import Stop
from service.contract.frames import ContractError, Finger

PRESSES = ((0.0, 15.0), (0.0, -15.0))
"""Errors of the presses that identify the gel: a turned object lies on both blocks and is pushed straight up."""
GRIP_TO_HALVE_N = 20.0
"""From this grip on, the other grip of the presses is half of it, else twice."""
REACH = (15.0, 15.0)
"""Largest errors of probes to learn from: the training range of the released networks."""
FITS = (2.5, 3.0)
"""Approximate errors that insert: no probe begins there."""
GRASPS_N = 3
"""Most grasps without a probe to keep: in some the object hangs too far askew to be pressed, others are stale."""
PER_GRASP = 5
"""Probes to learn from with one grasp, as in the paper; fewer where the hand cannot hold the object upright."""
STALE = "stale"
"""Reason for which a probe whose pictures came too late got no answer: it tells nothing of the wiring or the gels."""


class Ended(NamedTuple):
    """How probes with one grasp ended: their stored form, the phase, the reason of a failure, the gels, the last stop.

    ``probes``: those that were answered, or went in.
    """

    probes: tuple[Probe, ...]
    phase: Phase
    reason: str
    gels: dict[Finger, str]
    stop: Stop | None = None


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


def second_grip_n(grip_n: float) -> float:
    """The other grip of the presses: half of the cell's own, or twice a light one."""
    return 0.5 * grip_n if grip_n >= GRIP_TO_HALVE_N else 2.0 * grip_n


@dataclass(slots=True)
class Commissioning:
    """Carries out the commissioning. ``fetch`` regrasps the object.

    ``probe`` is one probe from the arm's present pose with unknown signs. ``several`` are probes at these errors with
    one grasp; each is passed on as soon as it has been answered.
    ``press`` is a probe that goes on until the gel slides, with one of ``grips_n`` (N, None: as set; none: no presses).
    ``press_at`` is a slow or fast probe (True), the object held from before; None: the lateness is not measured.
    ``picture`` is the picture of a probe with this name and caption, of those before the probes to learn from; None:
    none. ``path`` is the record's; its probes are not repeated.
    """

    path: Path
    record: Record
    probe: Callable[[float, float], Awaitable[Ended]]
    several: Callable[[Sequence[tuple[float, float]], Callable[[Answered], None]], Awaitable[Ended]]
    fetch: Callable[[], Awaitable[None]]
    draw: Callable[[int], tuple[float, float]]
    show: Callable[[str], None]
    press: Callable[[float | None, float, float], Awaitable[Ended]] | None = None
    grips_n: Sequence[float | None] = ()
    press_at: Callable[[float, float, bool], Awaitable[Ended]] | None = None
    picture: Callable[[str, str], Awaitable[str]] | None = None
    stale_n: int = 0  # attempts so far in which the arm paused, and which were made again
    _began_s: float = field(default_factory=time.monotonic)
    _before_n: int = field(init=False)  # probes of earlier runs, which this one's time does not count

    def __post_init__(self) -> None:
        self._before_n = self.record.done_n

    async def run(self, probes_n: int) -> Record:
        """Wiring check first; if it fails nothing else is done. Its four probes and the presses are of ``probes_n``.

        Raises DriverError if the cell fails or is stopped.
        """
        try:
            while len(self.record.signs) < len(SIDES):
                number = len(self.record.signs)
                done = await self._probe(f"sign {number + 1} of {len(SIDES)}", *SIDES[number])
                signs = (*self.record.signs, done)
                pictures = await self._pictured(f"sign_{number + 1}", done)
                named = mistakes(signs) if len(signs) == len(SIDES) else ()
                self._keep(signs=signs, named=named, pictures=pictures)
            self._keep(named=mistakes(self.record.signs))  # an older record may have been cut off before them
            if self.press_at and not self.record.named and self.record.late_s is None:
                self._keep(timed=await self._timed(self.press_at))
            presses = [(*place, grip_n) for grip_n in self.grips_n for place in PRESSES]
            while self.press and not self.record.named and len(self.record.presses) < len(presses):
                number = len(self.record.presses)
                x_mm, theta_deg, grip_n = presses[number]
                title = f"press {number + 1} of {len(presses)}" + (f" at {grip_n:g} N" if grip_n else "")
                done = await self._probe(title, x_mm, theta_deg, partial(self.press, grip_n))
                pictures = await self._pictured(f"press_{number + 1}", done)
                self._keep(presses=(*self.record.presses, done), pictures=pictures)
            while not self.record.named and self.record.done_n < probes_n:
                await self._probe_several(probes_n)
        except asyncio.CancelledError:
            raise DriverError(
                "operator: interrupted between two probes, nothing moves; run it again to go on"
            ) from None
        return self.record

    async def _timed(self, press_at: Callable[[float, float, bool], Awaitable[Ended]]) -> tuple[Press, ...]:
        """The presses at two speeds, none if they do not tell how late the cell is.

        All are in one grasp, unless the object turns in the hand meanwhile: then it is regrasped.
        """
        series, why = list[Press](), ""
        while (fast := next_is_fast(series)) is not None:
            try:
                ended = await press_at(*PLACE, fast) if series else None
                if afresh := ended is None or ended.reason.startswith(REFUSED):
                    fast = False
                    ended = await self._in_new_grasp(partial(press_at, *PLACE, fast))
            except LimitError as error:
                why = f" ({error})"
                break
            assert ended is not None
            title = f"{'fast' if fast else 'slow'} press {len(series) + 1}"
            stop = self._checked(title, ended).stop
            at = f"stopped at {stop.depth_mm:.2f} mm" if stop else "not stopped by what was pressed, or it paused"
            self.show(f"{title}: {at}")
            series.append(Press(fast=fast, stop=stop, afresh=afresh))
        if late_s(series) is None:
            self.show(f"HOW LATE pictures and arm are IS NOT KNOWN{why}: see lease.stop_lag_s")
            return ()
        return tuple(series)

    async def _probe(
        self, title: str, x_mm: float, theta_deg: float, how: Callable[[float, float], Awaitable[Ended]] | None = None
    ) -> Probe:
        for _ in range(GRASPS_N):
            ended = self._checked(title, await self._in_new_grasp(partial(how or self.probe, x_mm, theta_deg)))
            (done,) = ended.probes
            if not done.said.startswith(STALE):
                break
            self.stale_n += 1
            self.show(f"{title}: nothing is learnt in this grasp: {done.said}")
        self.show(f"{title}: {in_words(done)}")
        return done

    async def _probe_several(self, probes_n: int) -> None:
        """Probe at the next errors with one grasp, at as many as it allows; each is kept while the next is under way.

        Raises DriverError where none of several grasps in a row gives a probe to learn from.
        """
        made, done_n = {(one.x_mm, one.theta_deg) for one in self.record.probes}, self.record.done_n
        left = (place for place in map(self.draw, count()) if place not in made)
        places = list(islice(left, min(PER_GRASP, probes_n - done_n)))
        for _ in range(GRASPS_N):
            answered: asyncio.Queue[Answered | None] = asyncio.Queue()
            keeping = asyncio.create_task(self._keep_each(answered, probes_n))
            try:
                ended = await self._in_new_grasp(partial(self.several, places, answered.put_nowait))
            finally:
                answered.put_nowait(None)
                await asyncio.wait({keeping})
            if problem := keeping.result():
                raise problem
            title = f"probe {self.record.done_n + 1} of {probes_n}"
            if not (ended.probes and ended.reason.startswith(REFUSED)):
                self._checked(title, ended)
            if self.record.done_n > done_n:
                return
        raise DriverError(f"{title}: nothing is learnt in {GRASPS_N} grasps in a row: {ended.probes[-1].said}")

    async def _keep_each(self, answered: asyncio.Queue[Answered | None], probes_n: int) -> Exception | None:
        """Keep probes until None comes; what is wrong with one, after which none is kept."""
        problem: Exception | None = None
        while (one := await answered.get()) is not None:
            title = f"probe {self.record.done_n + 1} of {probes_n}{self._left(probes_n)}"
            try:
                if one.probe.said.startswith(STALE):
                    self.stale_n += 1
                    self.show(f"{title}: nothing is learnt from this attempt: {one.probe.said}")
                elif not problem:
                    self.check_gels(one.gels, title)
                    kept = partial(self._keep, probes=(*self.record.probes, one.probe))
                    await asyncio.to_thread(kept)  # the arm is guided meanwhile
                    self.show(f"{title}: {in_words(one.probe)}")
            except (ContractError, DriverError) as error:
                problem = error
        return problem

    async def _pictured(self, name: str, probe: Probe) -> dict[str, str]:
        """The record's pictures with the one of this probe, which is written before the record names it."""
        if self.picture is None:
            return self.record.pictures
        file = f"{name}.svg"
        caption = f"{self.record.begun}, {name}: {probe.x_mm:+.1f} mm, {probe.theta_deg:+.1f} deg; {probe.insertion_id}"
        text = await self.picture(probe.insertion_id, caption)
        return {**self.record.pictures, file: keep_text(self.path.with_name(file), text)}

    async def _in_new_grasp(self, probe: Callable[[], Awaitable[Ended]]) -> Ended:
        """Regrasp and probe; once more where the object then hangs too far askew in the hand.

        Probes with unknown signs have a grasp each: a press turns the object, and nothing could straighten it.
        """
        for _ in range(GRASPS_N):
            await self.fetch()
            ended = await probe()
            if ended.probes or not ended.reason.startswith(REFUSED):
                break
            self.show(f"not pressed in this grasp: {ended.reason}")
        return ended

    def _checked(self, title: str, ended: Ended) -> Ended:
        """The same, if the probe was carried out on the gels of the ones before; raises DriverError."""
        if ended.phase is not Phase.PROBED:
            raise DriverError(f"{title}: {ended.reason}")
        self.check_gels(ended.gels, title)
        self.record = self.record.model_copy(update={"gels": ended.gels})
        return ended

    def check_gels(self, gels: dict[Finger, str], title: str) -> None:
        """Raise DriverError if these are not the gels of the probes before."""
        if gels != (self.record.gels or gels):
            raise DriverError(f"{title}: a gel was changed or calibrated again; remove {self.path} and begin anew")

    def _left(self, probes_n: int) -> str:
        done_n = self.record.done_n
        if (made_n := done_n - self._before_n) <= len(SIDES):
            return ""
        left_s = (time.monotonic() - self._began_s) / made_n * (probes_n - done_n)
        return f", {left_s / 60.0:.0f} min left" if left_s > 90.0 else ""

    def _keep(self, **changed: object) -> None:
        record = self.record.model_copy(update=changed)
        keep_record(self.path, record)
        self.record = record  # only now: what no disk has taken, no insertion will know
