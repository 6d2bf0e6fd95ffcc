"""The WSG-50's binary protocol over TCP.

Frames are routed by id: replies to the request that waits for them, auto-updates to the watch.
"""

import asyncio
import contextlib
import time
from dataclasses import dataclass, field

from robot_client.grippers.wsg50 import codec
from robot_client.grippers.wsg50.codec import Command, Reply, Status, SystemState, UpdateFlag, Value
from robot_client.grippers.wsg50.gripper import GripperError, Wsg50
from robot_client.ports import Finding, HomingDirection
from service.contract.frames import Contract

_READ_BYTES = 4096


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
class BinaryWsg50(Wsg50):
    """Gripper port in binary mode; ``system`` and ``limits`` as read when it was connected."""

    system: SystemState = field(default_factory=lambda: SystemState(0))
    limits: GripperLimits | None = None
    _reader: asyncio.Task[None] | None = None
    _waiting: dict[int, asyncio.Queue[Reply]] = field(default_factory=dict)
    _parser: codec.StreamParser = field(default_factory=codec.StreamParser)
    _lost: str = ""

    async def connect(self) -> None:
        """Connect and read limits, system state and grasping state; raises GripperError. Moves nothing."""
        reader = await self._open()
        self._silence.heard(time.monotonic())
        self._reader = asyncio.get_running_loop().create_task(self._read(reader))
        stroke, v0, v1, a0, a1, f0, f1, _ = (float(v) for v in (await self.request(Command.SYSTEM_LIMITS)).values)
        self.limits = GripperLimits(
            stroke_mm=stroke, speed_mm_s=(v0, v1), acceleration_mm_s2=(a0, a1), force_n=(f0, f1)
        )
        (bits,) = (await self.request(Command.SYSTEM_STATE, UpdateFlag.ONCE, 0)).values
        self.system = SystemState(int(bits))
        await self.request(Command.GRASPING_STATE, UpdateFlag.ONCE, 0)

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

    async def acknowledge(self) -> None:
        """Clear a latched fault; raises GripperError."""
        await self.request(Command.ACKNOWLEDGE, codec.ACKNOWLEDGE_WORD)

    async def width_mm(self) -> float:
        """Opening between the fingers; raises GripperError."""
        (width,) = (await self.request(Command.WIDTH, UpdateFlag.ONCE, 0)).values
        return float(width)

    def findings(self) -> list[Finding]:
        """Faults, homing, and the force limit against the gripper's own."""
        assert self.limits is not None
        faults, force_n = self.system & codec.FAULT_BITS, self.settings.force_limit_n
        low_n, high_n = self.limits.force_n
        homed = SystemState.REFERENCED in self.system
        return [
            Finding(not faults, f"faults: {faults.name or 'none'}" if faults else "no fault"),
            Finding(homed, "homed" if homed else f"not homed: run {_HOME}"),
            Finding(low_n <= force_n <= high_n, f"force limit {force_n:g} N of {self.limits.force_n} N"),
        ]

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

    def _fault(self) -> str:
        faults = self.system & codec.FAULT_BITS
        return f"fault {faults.name}" if faults else ""

    async def _subscribe(self) -> None:
        await self.request(Command.GRASPING_STATE, UpdateFlag.PERIODIC, self.settings.update_period_ms)

    async def _home(self, direction: HomingDirection) -> None:
        await self.request(Command.HOMING, int(codec.HomingDirection[direction.upper()]))

    async def _close_fingers(self) -> None:
        settings, limits = self.settings, self.limits
        assert limits is not None
        if SystemState.REFERENCED not in self.system:
            raise GripperError(f"gripper: not homed; run {_HOME}")
        limits.check("force_limit_n", settings.force_limit_n, limits.force_n)
        limits.check("grasp_speed_mm_s", settings.grasp_speed_mm_s, limits.speed_mm_s)
        limits.check("grasp_width_mm", settings.grasp_width_mm, (0.0, limits.stroke_mm))
        await self.request(Command.SET_FORCE_LIMIT, settings.force_limit_n)
        await self.request(Command.GRASP, settings.grasp_width_mm, settings.grasp_speed_mm_s)
        await self._subscribe()

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
            self._on_state(float(reply.values[0]))
        if reply.command in self._waiting:
            self._waiting[reply.command].put_nowait(reply)


_HOME = "`python -m robot_client home --live` with empty fingers"
