"""The WSG-50 as the client's gripper: grasp with a force limit, watch the grasp, notice a lost part.

No program ever acknowledges a fault: that is an operator's command (`python -m robot_client home --acknowledge`).
During an insertion the gripper is never stopped, because STOP ends its part monitoring; the arm stops instead.
"""

import asyncio
import math
import time
from collections.abc import Coroutine
from dataclasses import dataclass, field
from typing import Any, Literal

from robot_client.grippers.wsg50 import codec, codes
from robot_client.grippers.wsg50.codec import Reply
from robot_client.grippers.wsg50.codes import FAULT_BITS, Command, GraspingState, SystemState, UpdateFlag
from robot_client.grippers.wsg50.link import GripperError, Link
from robot_client.grippers.wsg50.settings import Settings
from robot_client.insertion.events import Failure, Grasped, PartLost, Width
from robot_client.ports import Check, Finding, Gripper, HomingDirection, Post
from robot_client.silence import Silence

_HOME = "`python -m robot_client home --live --config FILE` with empty fingers"
_ACKNOWLEDGE = "`python -m robot_client home --live --config FILE --acknowledge` with empty fingers"
_WIDTH_STEP_MM = 0.1  # a smaller change of the width is not reported
_OPENED_MM = 1.0


@dataclass(slots=True)
class Wsg50(Gripper):
    """The Gripper port; ``limits`` holds the gripper's own limits (0x53) for keys of the settings."""

    settings: Settings
    state: GraspingState | None = None
    system: SystemState = field(default_factory=lambda: SystemState(0))
    limits: dict[str, tuple[float, float]] = field(default_factory=dict)
    _post: Post | None = None
    _posted_mm: float = math.inf
    _link: Link = field(init=False)
    _silence: Silence = field(init=False)
    _tasks: set[asyncio.Task[None]] = field(default_factory=set)

    def __post_init__(self) -> None:
        self._link = Link(self.settings, self._on_reply, self._on_end)
        self._silence = Silence(self.settings.silence_s, self.settings.silence_s / 4.0)

    @property
    def held(self) -> bool:
        return self.state is GraspingState.HOLDING

    # ---- port -----------------------------------------------------------------------------------------------------

    async def connect(self) -> None:
        """Connect and read limits, system state and grasping state; raises GripperError. Moves nothing."""
        await self._link.open()
        self._silence.heard(time.monotonic())
        stroke, v0, v1, _, _, f0, f1, _ = (float(v) for v in (await self._link.request(Command.SYSTEM_LIMITS)).values)
        self.limits = {"force_limit_n": (f0, f1), "grasp_speed_mm_s": (v0, v1), "grasp_width_mm": (0.0, stroke)}
        await self._read_state()

    async def start(self, post: Post) -> None:
        """Connect, then watch the grasping state; raises GripperError, also for a latched fault."""
        await self.connect()
        self._check_healthy()
        await self._subscribe()
        self._post = post
        self._spawn(self._watch())

    async def close(self) -> None:
        """Announce the disconnect (else the gripper latches a fast stop) and leave; the fingers stay in place."""
        self._post = None
        for task in list(self._tasks):
            task.cancel()
        once = UpdateFlag.ONCE, 0
        await self._link.close(((Command.WIDTH, once), (Command.GRASPING_STATE, once), (Command.DISCONNECT, ())))
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def grasp(self) -> None:
        """Accept an object that is already held; otherwise close on one with the force limit."""
        self._spawn(self._grasp())

    async def acknowledge(self) -> None:
        """Clear a latched fault; raises GripperError."""
        await self._link.request(Command.ACKNOWLEDGE, codec.ACKNOWLEDGE_WORD)
        await self._read_state()  # a part may still be held

    async def width_mm(self) -> float:
        """Opening between the fingers; raises GripperError."""
        return float((await self._link.request(Command.WIDTH, UpdateFlag.ONCE, 0)).values[0])

    def checks(self) -> dict[str, Check]:
        """Connection, faults, limits and state."""
        return {"gripper": self._check}

    async def home(self, direction: HomingDirection) -> float:
        """Reference the axis; refuses while something is held, since homing opens the fingers. Width in mm.

        A gripper forgets its part with its last client. So the fingers close first, if they can and were not told to
        open: who repeats a refused command must not drop what was refused.
        """
        self._check_healthy()
        can_feel = direction != "outward" and SystemState.REFERENCED in self.system
        known = ": open the fingers in its web page" if self.held else ""
        if self.held or (can_feel and not await self.finds_nothing()):
            raise GripperError(f"gripper: holds a part; homing would drop it{known}")
        await self._link.request(Command.HOMING, int(codes.HomingDirection[direction.upper()]))
        return await self.width_mm()

    async def release(self, width_mm: float) -> float:
        """Open to ``width_mm``; raises GripperError if the fingers stop elsewhere or still hold something."""
        await self._open_fingers(width_mm)
        reached_mm = await self.width_mm()
        if not abs(reached_mm - width_mm) <= _OPENED_MM or self.held:
            raise GripperError(f"gripper: width is {reached_mm:.1f} mm after opening, expected {width_mm:g} mm")
        return reached_mm

    async def finds_nothing(self) -> bool:
        """Close as for a grasp: True if that ends without a part; raises GripperError on any other failure."""
        try:
            await self._close_fingers()
        except GripperError:
            await self._read_state()
            if self.state is GraspingState.NO_PART:
                return True
            raise
        return False

    async def _subscribe(self) -> float:
        """Have state and width sent until one is asked for once, which ends it ([M] 3.4.1); returns the width in mm."""
        for command in (Command.GRASPING_STATE, Command.WIDTH):
            reply = await self._link.request(command, UpdateFlag.PERIODIC, self.settings.update_period_ms)
        return float(reply.values[0])

    async def _open_fingers(self, width_mm: float) -> None:
        self._check_ready()
        low, high = self.limits["grasp_width_mm"]
        if not low <= width_mm <= high:
            raise GripperError(f"gripper: cannot open to {width_mm:g} mm, this gripper allows {low:g} .. {high:g}")
        if not width_mm > (closed_mm := self.settings.grasp_width_mm):
            raise GripperError(
                f"gripper: cannot open to {width_mm:g} mm, expected more than grasp_width_mm = {closed_mm:g}"
            )
        self._check_allowed("grasp_speed_mm_s")
        command = Command.RELEASE if self.held else Command.MOVE
        kind = () if self.held else (codes.MoveFlag.STOP_ON_BLOCK,)
        await self._link.request(command, *kind, width_mm, self.settings.grasp_speed_mm_s)
        await self._read_state()

    async def _read_state(self) -> None:
        self.system = SystemState(int((await self._link.request(Command.SYSTEM_STATE, UpdateFlag.ONCE, 0)).values[0]))
        await self._link.request(Command.GRASPING_STATE, UpdateFlag.ONCE, 0)

    def _check_healthy(self) -> None:
        if faults := self.system & FAULT_BITS:
            raise GripperError(f"gripper: fault {faults.name}; find the cause, then {_ACKNOWLEDGE}")

    def _check_ready(self) -> None:
        self._check_healthy()
        if SystemState.REFERENCED not in self.system:
            raise GripperError(f"gripper: not homed; run {_HOME}")

    def _allowed(self, name: str) -> Finding:
        """Whether the gripper allows a value of the settings; out of range it may clamp or latch a fast stop."""
        (low, high), value = self.limits[name], getattr(self.settings, name)
        return Finding(low <= value <= high, f"{name} = {value:g}, this gripper allows {low:g} .. {high:g}")

    def _check_allowed(self, *names: str) -> None:
        for allowed, text in map(self._allowed, names):
            if not allowed:
                raise GripperError(f"gripper: {text}")

    async def _close_fingers(self) -> None:
        self._check_ready()
        self._check_allowed(*self.limits)
        await self._link.request(Command.SET_FORCE_LIMIT, self.settings.force_limit_n)
        await self._link.request(Command.GRASP, self.settings.grasp_width_mm, self.settings.grasp_speed_mm_s)

    # ---- background -----------------------------------------------------------------------------------------------

    async def _check(self) -> list[Finding]:
        """Faults, homing, the settings against the gripper's own limits, state and width."""
        await self.connect()
        width_mm = await self.width_mm()
        faults = self.system & FAULT_BITS
        homed = SystemState.REFERENCED in self.system
        cool = SystemState.TEMP_WARNING not in self.system
        return [
            Finding(not faults, f"faults: {faults.name or 'none'}" if faults else "no fault"),
            Finding(homed, "homed" if homed else f"not homed: run {_HOME}"),
            Finding(cool, "no temperature warning" if cool else "temperature warning"),
            *map(self._allowed, self.limits),
            Finding(True, f"grasping state {self.state and self.state.name}, width {width_mm:.1f} mm"),
        ]

    async def _grasp(self) -> None:
        try:
            if not self.held and await self.finds_nothing():
                at = f"grasp_width_mm = {self.settings.grasp_width_mm:g}"
                raise GripperError(f"gripper: closed to {at} on nothing; is the object between the fingers?")
            width_mm = await self._subscribe()
        except GripperError as error:
            self._fail("grasp", str(error))
            return
        if not self.held:
            self._fail("grasp", f"gripper: grasping state is {self.state and self.state.name}, expected HOLDING")
        elif self._post is not None:
            self._post(Grasped(at_s=time.monotonic(), width_mm=width_mm))

    def _on_end(self, why: str) -> None:
        self._fail("link", f"gripper: {why}")

    def _on_reply(self, reply: Reply) -> None:
        if reply.command == Command.GRASPING_STATE and reply.values:
            self._silence.heard(time.monotonic())
            self._on_state(float(reply.values[0]))
        if reply.command == Command.WIDTH and reply.values:
            self._on_width(float(reply.values[0]))

    def _on_state(self, value: float) -> None:
        if value not in tuple(GraspingState):
            self._fail("protocol", f"gripper: grasping state {value:g}, expected 0..7")
            return
        before, self.state = self.state, GraspingState(int(value))
        if self._post is None or self.state is before:
            return
        if self.state is GraspingState.ERROR:
            met = "" if before is GraspingState.HOLDING else ", or contact outside its Part Width Tolerance"
            self._fail("error", f"gripper: fast stop or fault{met}; find the cause, then {_ACKNOWLEDGE}")
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
        """Updates of the grasping state are the heartbeat: their absence is a failure."""
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


make = Wsg50
