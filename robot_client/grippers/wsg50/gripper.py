"""The WSG-50 in either protocol: grasp with a force limit, watch the grasp, notice a lost part.

No program ever acknowledges a fault: that is an operator's command (`python -m robot_client home --acknowledge`).
During an insertion the gripper is never stopped: STOP ends its part monitoring; the arm is what stops.
"""

import asyncio
import math
import time
from abc import abstractmethod
from collections.abc import Coroutine
from dataclasses import dataclass, field
from typing import Any, Literal

from robot_client.grippers.wsg50.codes import GraspingState
from robot_client.grippers.wsg50.settings import Settings
from robot_client.insertion.events import Failure, Grasped, PartLost, Width
from robot_client.ports import Check, DriverError, Finding, Gripper, HomingDirection, Post
from robot_client.silence import Silence

_WIDTH_STEP_MM = 0.1  # a smaller change of the width is not reported
_OPENED_MM = 1.0


class GripperError(DriverError):
    """The gripper refused, failed or fell silent; the text names the request."""


@dataclass(slots=True)
class Wsg50(Gripper):
    """The Gripper port; a protocol adds how it asks and what it reads."""

    settings: Settings
    state: GraspingState | None = None
    _post: Post | None = None
    _writer: asyncio.StreamWriter | None = None
    _posted_mm: float = math.inf
    _silence: Silence = field(init=False)
    _tasks: set[asyncio.Task[None]] = field(default_factory=set)

    def __post_init__(self) -> None:
        self._silence = Silence(self.settings.silence_s, self.settings.silence_s / 4.0)

    @property
    def held(self) -> bool:
        return self.state is GraspingState.HOLDING

    # ---- port -----------------------------------------------------------------------------------------------------

    async def start(self, post: Post) -> None:
        """Connect, then watch the grasping state; raises GripperError, also for a latched fault."""
        await self.connect()
        fault = self._fault()
        if fault:
            acknowledge = "`python -m robot_client home --live --acknowledge`"
            raise GripperError(f"gripper: {fault}; find the cause, then {acknowledge}")
        await self._subscribe()
        self._post = post
        self._spawn(self._watch())

    def grasp(self) -> None:
        """Accept a held object as it is; otherwise close on one with the force limit."""
        self._spawn(self._grasp())

    def checks(self) -> dict[str, Check]:
        """Connection, faults, limits and state."""
        return {"gripper": self._check}

    async def home(self, direction: HomingDirection) -> float:
        """Reference the axis; refuses while something is held, since homing opens the fingers. Width in mm."""
        if self.state is GraspingState.HOLDING:
            raise GripperError("gripper: holds a part; homing would drop it")
        await self._home(direction)
        return await self.width_mm()

    async def release(self, width_mm: float) -> float:
        """Open to ``width_mm``; raises GripperError if the fingers stand elsewhere then, or still hold something."""
        if fault := self._fault():
            raise GripperError(f"gripper: {fault}; nothing is opened")
        await self._open_fingers(width_mm)
        reached_mm = await self.width_mm()
        if not abs(reached_mm - width_mm) <= _OPENED_MM or self.held:
            raise GripperError(f"gripper: width is {reached_mm:.1f} mm after opening, expected {width_mm:g} mm")
        return reached_mm

    async def finds_nothing(self) -> bool:
        """Close as for a grasp: True if that ends without a part; raises GripperError for any other trouble."""
        try:
            await self._close_fingers()
        except GripperError:
            await self._read_state()
            if self.state is GraspingState.NO_PART:
                return True
            raise
        return False

    # ---- what a protocol adds to connect, close and acknowledge ---------------------------------------------------

    @abstractmethod
    async def width_mm(self) -> float:
        """Opening between the fingers; raises GripperError."""

    @abstractmethod
    def findings(self) -> list[Finding]:
        """What :meth:`connect` has read, but for state and width."""

    @abstractmethod
    def _fault(self) -> str:
        """A latched fault by name, or nothing."""

    @abstractmethod
    async def _subscribe(self) -> None:
        """Have the grasping state and the width sent periodically."""

    @abstractmethod
    async def _read_state(self) -> None:
        """Have the grasping state as it is now."""

    @abstractmethod
    async def _home(self, direction: HomingDirection) -> None: ...

    @abstractmethod
    async def _open_fingers(self, width_mm: float) -> None:
        """Open to a width, letting go of what is held, and wait until that is done; raises GripperError."""

    @abstractmethod
    async def _close_fingers(self) -> None:
        """Close on a part and wait until the state has followed; raises GripperError."""

    # ---- background -----------------------------------------------------------------------------------------------

    async def _open(self) -> asyncio.StreamReader:
        opening = asyncio.open_connection(self.settings.host, self.settings.port)
        try:
            reader, self._writer = await asyncio.wait_for(opening, self.settings.reply_timeout_s)
        except (OSError, TimeoutError) as error:
            where, why = self.settings.address, f"{type(error).__name__} {error}".rstrip()
            raise GripperError(f"gripper: cannot connect to {where}: {why}") from None
        return reader

    async def _check(self) -> list[Finding]:
        await self.connect()
        assert self.state is not None
        width_mm = await self.width_mm()
        return [*self.findings(), Finding(True, f"grasping state {self.state.name}, width {width_mm:.1f} mm")]

    async def _grasp(self) -> None:
        try:
            if self.state is not GraspingState.HOLDING:
                await self._close_fingers()
            width_mm = await self.width_mm()
        except GripperError as error:
            self._fail("grasp", str(error))
            return
        if self.state is not GraspingState.HOLDING:
            name = self.state.name if self.state is not None else "unknown"
            self._fail("grasp", f"gripper: grasping state is {name}, expected HOLDING")
        elif self._post is not None:
            self._post(Grasped(at_s=time.monotonic(), width_mm=width_mm))

    def _on_state(self, value: float) -> None:
        if value not in tuple(GraspingState):
            self._fail("protocol", f"gripper: grasping state {value:g}, expected 0..7")
            return
        before, self.state = self.state, GraspingState(int(value))
        if self._post is None or self.state is before:
            return
        if self.state is GraspingState.ERROR:
            self._fail("error", "gripper: grasping state ERROR (fast stop or fault)")
        elif before is GraspingState.HOLDING:
            if self.state in (GraspingState.PART_LOST, GraspingState.NO_PART):
                self._post(PartLost(at_s=time.monotonic()))
            else:
                self._fail("released", f"gripper: left HOLDING for {self.state.name} without an order")

    def _on_width(self, width_mm: float) -> None:
        if self._post is not None and math.isfinite(width_mm) and abs(width_mm - self._posted_mm) >= _WIDTH_STEP_MM:
            self._posted_mm = width_mm
            self._post(Width(at_s=time.monotonic(), width_mm=width_mm))

    async def _watch(self) -> None:
        """Updates of the grasping state are the heartbeat: silence about it is a failure."""
        while True:
            await asyncio.sleep(self.settings.silence_s / 4.0)
            silent_s = self._silence.over(time.monotonic())
            if silent_s is not None:
                self._fail("silent", f"gripper: no grasping state for {silent_s * 1e3:.0f} ms")

    def _fail(self, code: Literal["grasp", "link", "protocol", "error", "released", "silent"], detail: str) -> None:
        if self._post is not None:
            post, self._post = self._post, None
            post(Failure(at_s=time.monotonic(), source="gripper", code=code, detail=detail))

    def _spawn(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
