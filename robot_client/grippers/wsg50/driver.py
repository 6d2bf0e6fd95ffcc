"""The WSG-50 over TCP: grasp with a force limit, watch the grasp, notice a lost part.

Frames are routed by id: replies to the request that waits for them, auto-updates to the watch. Faults are never
acknowledged by a program: that is an operator's deliberate call (`python -m robot_client home --acknowledge`).
During an insertion the gripper is never stopped: STOP ends its part monitoring; the arm is what stops.
"""

import asyncio
import contextlib
import time
from collections.abc import Coroutine
from dataclasses import dataclass, field
from typing import Any, Literal

from pydantic import Field

from robot_client.grippers.wsg50 import codec
from robot_client.grippers.wsg50.codec import Command, GraspingState, Reply, Status, SystemState, UpdateFlag, Value
from robot_client.insertion.events import Failure, Grasped, PartLost
from robot_client.ports import DriverError, Post
from robot_client.silence import Silence
from service.contract.frames import Contract

_READ_BYTES = 4096


class GripperError(DriverError):
    """The gripper refused, failed or fell silent; the text says at what."""


class WsgSettings(Contract):
    """Where the gripper is and how it grasps. Ranges are checked against the gripper's own limits (0x53)."""

    protocol: Literal["binary", "text"] = "binary"
    host: str = "192.168.1.20"
    port: int = Field(default=codec.TCP_PORT, ge=0, le=65535)
    grasp_width_mm: float = 40.0
    grasp_speed_mm_s: float = 30.0
    force_limit_n: float = Field(default=40.0, gt=0)
    reply_timeout_s: float = Field(default=1.0, gt=0)
    motion_timeout_s: float = Field(default=10.0, gt=0)
    update_period_ms: int = Field(default=20, ge=10, le=1000)
    silence_s: float = Field(default=0.5, gt=0)


class GripperLimits(Contract):
    """Answer to 0x53, mm, mm/s, mm/s2, N."""

    stroke_mm: float
    speed_mm_s: tuple[float, float]
    acceleration_mm_s2: tuple[float, float]
    force_n: tuple[float, float]

    def check(self, name: str, value: float, bounds: tuple[float, float]) -> float:
        """``value`` if within ``bounds``; raises GripperError (out of range may be clamped or latch a fast stop)."""
        if not bounds[0] <= value <= bounds[1]:
            raise GripperError(f"gripper: {name} = {value:g}, this gripper allows {bounds[0]:g} .. {bounds[1]:g}")
        return value


@dataclass(slots=True)
class Wsg50:
    """One gripper; the Gripper port and, for the operator's commands, single requests."""

    settings: WsgSettings
    state: GraspingState | None = None
    system: SystemState = field(default_factory=lambda: SystemState(0))
    limits: GripperLimits | None = None
    _post: Post | None = None
    _reader: asyncio.Task[None] | None = None
    _writer: asyncio.StreamWriter | None = None
    _waiting: dict[int, asyncio.Queue[Reply]] = field(default_factory=dict)
    _parser: codec.StreamParser = field(default_factory=codec.StreamParser)
    _silence: Silence = field(init=False)
    _lost: str = ""
    _tasks: set[asyncio.Task[None]] = field(default_factory=set)

    def __post_init__(self) -> None:
        self._silence = Silence(self.settings.silence_s, self.settings.silence_s / 4.0)

    # ---- port -----------------------------------------------------------------------------------------------------

    async def start(self, post: Post) -> None:
        """Connect, read limits and state, subscribe to the grasping state; raises GripperError."""
        await self.connect()
        faults = self.system & codec.FAULT_BITS
        if faults:
            raise GripperError(
                f"gripper: fault {faults.name}; find the cause, then `python -m robot_client home --live --acknowledge`"
            )
        await self.request(Command.GRASPING_STATE, UpdateFlag.PERIODIC, self.settings.update_period_ms)
        self._post = post
        self._spawn(self._watch())

    def grasp(self) -> None:
        """Accept a held object as it is; otherwise close on one with the force limit."""
        self._spawn(self._grasp())

    async def close(self) -> None:
        """Announce the disconnect (else the gripper latches a fast stop) and leave; the fingers stay as they are."""
        self._post = None
        for task in list(self._tasks):
            task.cancel()
        if self._writer is not None:
            with contextlib.suppress(GripperError):
                await self.request(Command.GRASPING_STATE, UpdateFlag.ONCE, 0)
            with contextlib.suppress(GripperError):
                await self.request(Command.DISCONNECT)
            self._writer.close()
        if self._reader is not None:
            self._reader.cancel()
            await asyncio.gather(self._reader, *self._tasks, return_exceptions=True)

    # ---- single requests ------------------------------------------------------------------------------------------

    async def connect(self) -> None:
        """Open the connection and read limits, system state and grasping state; raises GripperError. Moves nothing."""
        where = f"{self.settings.host}:{self.settings.port}"
        opening = asyncio.open_connection(self.settings.host, self.settings.port)
        try:
            reader, self._writer = await asyncio.wait_for(opening, self.settings.reply_timeout_s)
        except (OSError, TimeoutError) as error:
            raise GripperError(f"gripper: cannot connect to {where}: {type(error).__name__} {error}".rstrip()) from None
        self._silence.heard(time.monotonic())
        self._reader = asyncio.get_running_loop().create_task(self._read(reader))
        stroke, v0, v1, a0, a1, f0, f1, _ = (float(v) for v in (await self.request(Command.SYSTEM_LIMITS)).values)
        self.limits = GripperLimits(
            stroke_mm=stroke, speed_mm_s=(v0, v1), acceleration_mm_s2=(a0, a1), force_n=(f0, f1)
        )
        (bits,) = (await self.request(Command.SYSTEM_STATE, UpdateFlag.ONCE, 0)).values
        self.system = SystemState(int(bits))
        await self.request(Command.GRASPING_STATE, UpdateFlag.ONCE, 0)

    async def width_mm(self) -> float:
        """Opening between the fingers."""
        (width,) = (await self.request(Command.WIDTH, UpdateFlag.ONCE, 0)).values
        return float(width)

    async def home(self, direction: codec.HomingDirection = codec.HomingDirection.DEFAULT) -> None:
        """Reference the axis; refuses while something is held, since homing opens the fingers."""
        if self.state is GraspingState.HOLDING:
            raise GripperError("gripper: holds a part; homing would drop it")
        await self.request(Command.HOMING, int(direction))

    async def acknowledge(self) -> None:
        """Clear a latched fault: only ever on an operator's deliberate call."""
        await self.request(Command.ACKNOWLEDGE, codec.ACKNOWLEDGE_WORD)

    async def request(self, command: Command, *values: Value) -> Reply:
        """Send and wait for the final reply (the second one of a two-stage command); raises GripperError."""
        if self._writer is None or self._lost:
            raise GripperError(f"gripper: {command.name}: {self._lost or 'not connected'}")
        replies: asyncio.Queue[Reply] = asyncio.Queue()
        self._waiting[command] = replies
        self._writer.write(codec.encode_request(command, *values))
        try:
            reply = await asyncio.wait_for(replies.get(), self.settings.reply_timeout_s)
            if reply.status is Status.CMD_PENDING:
                reply = await asyncio.wait_for(replies.get(), self.settings.motion_timeout_s)
        except TimeoutError:
            raise GripperError(f"gripper: {command.name}: no reply in time") from None
        finally:
            self._waiting.pop(command, None)
        if reply.status is not Status.SUCCESS:
            raise GripperError(f"gripper: {command.name}: {self._lost or reply.status.name}")
        return reply

    # ---- background -----------------------------------------------------------------------------------------------

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

    async def _close_fingers(self) -> None:
        settings, limits = self.settings, self.limits
        assert limits is not None
        if SystemState.REFERENCED not in self.system:
            raise GripperError("gripper: not homed; run `python -m robot_client home --live` with empty fingers")
        limits.check("force_limit_n", settings.force_limit_n, limits.force_n)
        limits.check("grasp_speed_mm_s", settings.grasp_speed_mm_s, limits.speed_mm_s)
        limits.check("grasp_width_mm", settings.grasp_width_mm, (0.0, limits.stroke_mm))
        await self.request(Command.SET_FORCE_LIMIT, settings.force_limit_n)
        await self.request(Command.GRASP, settings.grasp_width_mm, settings.grasp_speed_mm_s)
        await self.request(Command.GRASPING_STATE, UpdateFlag.PERIODIC, settings.update_period_ms)

    async def _read(self, reader: asyncio.StreamReader) -> None:
        try:
            while data := await reader.read(_READ_BYTES):
                for frame in self._parser.feed(data):
                    self._route(frame)
            self._lost = "the gripper closed the connection"
        except OSError as error:
            self._lost = f"connection lost: {error}"
        for queue in self._waiting.values():
            queue.put_nowait(Reply(0, Status.IO_ERROR))
        self._fail("link", f"gripper: {self._lost}")

    def _route(self, frame: codec.Frame) -> None:
        try:
            reply = codec.decode_reply(frame)
        except codec.WsgError:
            return  # not of this protocol: whoever waits for it times out
        if reply.command == Command.GRASPING_STATE and reply.values:
            self._silence.heard(time.monotonic())
            self._on_state(int(reply.values[0]))
        if reply.command in self._waiting:
            self._waiting[reply.command].put_nowait(reply)

    def _on_state(self, value: int) -> None:
        try:
            new = GraspingState(value)
        except ValueError:
            self._fail("protocol", f"gripper: grasping state {value}, expected 0..7")
            return
        before, self.state = self.state, new
        if self._post is None or new is before:
            return
        if new in (GraspingState.PART_LOST, GraspingState.NO_PART) and before is GraspingState.HOLDING:
            self._post(PartLost(at_s=time.monotonic()))
        elif new is GraspingState.ERROR:
            self._fail("error", "gripper: grasping state ERROR (fast stop or fault)")
        elif before is GraspingState.HOLDING:
            self._fail("released", f"gripper: left HOLDING for {new.name} without being told")

    async def _watch(self) -> None:
        """Auto-updates of the grasping state are the heartbeat: silence about it is a failure."""
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
