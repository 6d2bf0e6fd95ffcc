"""The whole cycle of a packing cell: pick, insert, release, next; each part is an ordinary insertion.

Every step connects, does one thing and closes, so that each begins with the checks of its own start. The gripper opens
only when that is safe: with an empty hand, after a claimed insertion, or above the taught reject pose.
"""

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field

from pydantic import Field

from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.limits import Limits, Motion, check_pose
from robot_client.insertion.state import Phase, State
from robot_client.interrupts import to_the_end
from robot_client.ports import DriverError, Gripper
from robot_client.session.handshake import Handshake, HandshakeSettings
from robot_client.session.travel import Errands, Way, over_to, straight_up
from service.contract.frames import Contract

PATIENCE_S = 0.1
OPEN_MM = 1.0  # tolerance of the taught width
# After these the fault is the part's, nothing is broken, and the arm may carry it away; after all others it holds.
_THE_PARTS = ("turned_in_hand", "nothing_held", "implausible_width")
REJECTED = ("client: attempts:", "service: no_decision:", *(f"service: refused: {reason}:" for reason in _THE_PARTS))


class CycleSettings(Contract):
    """``[cycle]``: taught poses of the TCP and widths. ``reject`` None: hold with the object in the hand.

    ``pick``: pose in which the fingers close on an object in its fixture. ``retreat_mm``: straight up, clear of an
    object that stands there. ``regrasp``: an object that has turned in the hand is put back there, so nothing else may
    get there before it is in its gap; False for a fixture that fills up again.
    """

    pick: WorkPose
    open_mm: float = Field(gt=0, le=300)
    retreat_mm: float = Field(default=40.0, ge=1, le=500)
    regrasp: bool = True
    reject: WorkPose | None = None
    max_rejects_in_a_row: int = Field(default=2, ge=0, le=100)
    plc: HandshakeSettings | None = None

    def check(self, limits: Limits) -> None:
        """Raise LimitError for a taught pose, or the height above it, that is not allowed."""
        for name, pose in (("cycle.pick", self.pick), ("cycle.reject", self.reject)):
            if pose is not None:
                check_pose(limits, pose, name)
                check_pose(limits, self.above(pose), f"above {name}")

    def above(self, pose: WorkPose) -> WorkPose:
        """Where the arm comes to ``pose`` from, and leaves it to."""
        return pose.at_height(pose.z_mm + self.retreat_mm)


class CycleHeldError(DriverError):
    """The cycle ended with the arm holding; the text says why."""


@dataclass(slots=True)
class Pace:
    """A person's requests: pause, go on, stop after this part."""

    paused: bool = False
    ending: bool = False

    def order(self, word: str) -> str:
        match word.strip().lower():
            case "p" | "pause":
                self.paused = True
                return "pausing after this part"
            case "r" | "resume":
                self.paused = False
                return "going on"
            case "s" | "stop":
                self.ending = True
                return "stopping after this part"
        return "expected pause, resume or stop"


@dataclass(slots=True)
class Count:
    """Parts so far."""

    inserted_n: int = 0
    rejected_n: int = 0
    in_a_row_n: int = 0  # rejected

    def __str__(self) -> str:
        rejected = f", {self.rejected_n} rejected" if self.rejected_n else ""
        return f"{self.inserted_n} inserted{rejected}"


@dataclass(slots=True)
class Cycle:
    """Runs parts one after the other. ``insert`` does one insertion from wherever the arm stands."""

    settings: CycleSettings
    errands: Errands
    insert: Callable[[int], Awaitable[State]]
    show: Callable[[str], None]
    pace: Pace = field(default_factory=Pace)
    count: Count = field(default_factory=Count)
    plc: Handshake | None = None

    async def run(self, parts_n: int | None) -> Count:
        """Run until ``parts_n`` are inserted, or a person stops it; raises CycleHeldError, DriverError, LimitError."""
        fault = True
        try:
            await self._begin()
            while parts_n is None or self.count.inserted_n < parts_n:
                if not await self._asked():
                    break
                await self._part()
                if self.plc:
                    await self.plc.done()
            fault = False
        except asyncio.CancelledError:
            raise CycleHeldError("operator: interrupted between two steps, nothing moves") from None
        finally:
            if self.plc:
                await to_the_end(self._end(self.plc, fault=fault), interrupted=fault)
        return self.count

    async def _end(self, plc: Handshake, *, fault: bool) -> None:
        """Sign off; a controller that no longer answers hides no fault before it."""
        try:
            await plc.end(fault=fault)
        except DriverError as error:
            if not fault:
                raise
            self.show(f"the PLC may not know of the fault: {error}")

    async def _begin(self) -> None:
        if self.plc:
            await self.plc.begin()
        if not await self.errands.with_gripper(lambda gripper: is_empty(gripper, self.settings.open_mm)):
            raise CycleHeldError(
                "gripper: holds something before the first part; put it back where it is gripped (`jog --live"
                " --config FILE`) and open the fingers (`home --live --config FILE --direction outward`)"
            )

    async def _asked(self) -> bool:
        """Wait until the next part may begin; False if no more are wanted."""
        shown = ""
        while True:
            wanted = not (self.pace.paused or self.pace.ending)
            requested = await self.plc.asked(ready=wanted) if self.plc else True
            if requested and not self.pace.paused and not self.pace.ending:  # a person may have stopped it meanwhile
                if self.plc:
                    await self.plc.busy()
                return True
            if self.pace.ending and not wanted:
                if requested and self.plc:
                    raise CycleHeldError("operator: stopped; the part that the PLC requests was not begun")
                return False
            waits = "paused" if self.pace.paused else "waiting for the PLC"
            if waits != shown:
                self.show(waits)
                shown = waits
            await asyncio.sleep(PATIENCE_S)

    async def _part(self) -> None:
        number = self.count.inserted_n + self.count.rejected_n + 1
        self.show(f"part {number}: picking")
        await self._open()
        await self.errands.go(self._over_to(self.settings.pick))
        state = await self.insert(number)
        if state.phase is not Phase.INSERTED:
            await self._reject(number, state)
            return
        self.show(f"part {number}: letting go")
        await self._open()
        await self.errands.go(straight_up(self.settings.retreat_mm))
        await self._check_stayed(number)
        self.count.inserted_n, self.count.in_a_row_n = self.count.inserted_n + 1, 0
        self.show(f"part {number}: done after {state.attempt} attempt{'s' * (state.attempt != 1)}; {self.count}")

    async def _check_stayed(self, number: int) -> None:
        """Close the fingers again, to feel an object that came along with them."""
        if not await self.errands.with_gripper(lambda gripper: gripper.finds_nothing()):
            raise CycleHeldError(f"part {number}: the object came along with the fingers; it is not in the gap")

    async def _reject(self, number: int, state: State) -> None:
        """Carry away a part that could not be inserted, if that is taught and safe; raises CycleHeldError otherwise."""
        reject = self.settings.reject
        if reject is None or not state.reason.startswith(REJECTED):
            raise CycleHeldError(f"part {number}: {state.reason or 'not inserted'}")
        if self.count.in_a_row_n >= self.settings.max_rejects_in_a_row:
            raise CycleHeldError(f"part {number}: {self.count.in_a_row_n + 1} in a row; the last one: {state.reason}")
        if await self.errands.with_gripper(lambda gripper: gripper.finds_nothing()):
            raise CycleHeldError(f"part {number}: not inserted, and no longer in the hand; {state.reason}")
        self.show(f"part {number}: rejected ({state.reason})")
        await self.errands.go(self._over_to(reject, "retract"))
        await self._open()
        above = self.settings.above(reject)
        await self.errands.go(over_to(above, above.z_mm, "retract"))
        self.count.rejected_n, self.count.in_a_row_n = self.count.rejected_n + 1, self.count.in_a_row_n + 1

    def _over_to(self, taught: WorkPose, up: Motion = "travel") -> Way:
        return over_to(taught, max(self.errands.clear_mm, self.settings.above(taught).z_mm), up)

    async def _open(self) -> None:
        await self.errands.with_gripper(lambda gripper: gripper.release(self.settings.open_mm))


async def is_empty(gripper: Gripper, open_mm: float) -> bool:
    """At the taught width the fingers hold nothing; at any other width only closing them shows it."""
    if gripper.held:
        return False
    return await gripper.width_mm() >= open_mm - OPEN_MM or await gripper.finds_nothing()
