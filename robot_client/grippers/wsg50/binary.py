"""The WSG-50's binary protocol over TCP.

Frames are routed by id: replies to the request that waits for them, auto-updates to the watch.
"""

import asyncio
import contextlib
import time
from dataclasses import dataclass, field

from robot_client.grippers.wsg50 import codec, codes
from robot_client.grippers.wsg50.codec import Reply, Value
from robot_client.grippers.wsg50.codes import FAULT_BITS, Command, Status, SystemState, UpdateFlag
from robot_client.grippers.wsg50.gripper import GripperError, Wsg50
from robot_client.ports import Finding, HomingDirection

_READ_BYTES = 4096


@dataclass(slots=True)
class BinaryWsg50(Wsg50):
    """Gripper port in binary mode; ``limits`` holds what the gripper allows (0x53) for keys of the settings."""

    system: SystemState = field(default_factory=lambda: SystemState(0))
    limits: dict[str, tuple[float, float]] = field(default_factory=dict)
    _reader: asyncio.Task[None] | None = None
    _waiting: dict[int, asyncio.Queue[Reply]] = field(default_factory=dict)
    _parser: codec.StreamParser = field(default_factory=codec.StreamParser)
    _lost: str = ""

    async def connect(self) -> None:
        """Connect and read limits, system state and grasping state; raises GripperError. Moves nothing."""
        reader = await self._open()
        self._silence.heard(time.monotonic())
        self._reader = asyncio.get_running_loop().create_task(self._read(reader))
        stroke, v0, v1, _, _, f0, f1, _ = (float(v) for v in (await self.request(Command.SYSTEM_LIMITS)).values)
        self.limits = {"force_limit_n": (f0, f1), "grasp_speed_mm_s": (v0, v1), "grasp_width_mm": (0.0, stroke)}
        (bits,) = (await self.request(Command.SYSTEM_STATE, UpdateFlag.ONCE, 0)).values
        self.system = SystemState(int(bits))
        await self.request(Command.GRASPING_STATE, UpdateFlag.ONCE, 0)

    async def close(self) -> None:
        """Announce the disconnect (else the gripper latches a fast stop) and leave; the fingers stay as they are."""
        self._post = None
        for task in list(self._tasks):
            task.cancel()
        if self._writer is not None:
            for command in (Command.WIDTH, Command.GRASPING_STATE):
                with contextlib.suppress(GripperError):
                    await self.request(command, UpdateFlag.ONCE, 0)
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
        faults, force_n = self.system & FAULT_BITS, self.settings.force_limit_n
        low_n, high_n = self.limits["force_limit_n"]
        homed = SystemState.REFERENCED in self.system
        return [
            Finding(not faults, f"faults: {faults.name or 'none'}" if faults else "no fault"),
            Finding(homed, "homed" if homed else f"not homed: run {_HOME}"),
            Finding(low_n <= force_n <= high_n, f"force limit {force_n:g} N of {low_n, high_n} N"),
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
        faults = self.system & FAULT_BITS
        return f"fault {faults.name}" if faults else ""

    async def _subscribe(self) -> None:
        for command in (Command.WIDTH, Command.GRASPING_STATE):
            await self.request(command, UpdateFlag.PERIODIC, self.settings.update_period_ms)

    async def _home(self, direction: HomingDirection) -> None:
        await self.request(Command.HOMING, int(codes.HomingDirection[direction.upper()]))

    async def _open_fingers(self, width_mm: float) -> None:
        self._check_referenced()
        low, high = self.limits["grasp_width_mm"]
        if not low <= width_mm <= high:
            raise GripperError(f"gripper: cannot open to {width_mm:g} mm, this gripper allows {low:g} .. {high:g}")
        command = Command.RELEASE if self.held else Command.MOVE
        kind = () if self.held else (codes.MoveFlag.STOP_ON_BLOCK,)
        await self.request(command, *kind, width_mm, self.settings.grasp_speed_mm_s)
        await self._read_state()

    async def _read_state(self) -> None:
        await self.request(Command.GRASPING_STATE, UpdateFlag.ONCE, 0)

    def _check_referenced(self) -> None:
        if SystemState.REFERENCED not in self.system:
            raise GripperError(f"gripper: not homed; run {_HOME}")

    async def _close_fingers(self) -> None:
        settings = self.settings
        self._check_referenced()
        for name, (low, high) in self.limits.items():  # out of range it may clamp or latch a fast stop
            value = getattr(settings, name)
            if not low <= value <= high:
                raise GripperError(f"gripper: {name} = {value:g}, this gripper allows {low:g} .. {high:g}")
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
        if reply.command == Command.WIDTH and reply.values:
            self._on_width(float(reply.values[0]))
        if reply.command in self._waiting:
            self._waiting[reply.command].put_nowait(reply)


_HOME = "`python -m robot_client home --live` with empty fingers"
