"""The WSG-50's binary protocol over TCP: two-stage replies, auto-updates, and FAST STOP when a client vanishes.

One client at a time. Bytes come from ``robot_client.grippers.wsg50.codec``; what they do from :class:`Gripper`.
"""

import asyncio
import random
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from robot_client.grippers.wsg50.codec import (
    ACKNOWLEDGE_WORD,
    STATE_QUERIES,
    Frame,
    Request,
    StreamParser,
    Value,
    WsgError,
    decode_request,
    encode_reply,
)
from robot_client.grippers.wsg50.codes import Command, MoveFlag, Status
from simulation.cell.emulators.faults import FaultBoard, take
from simulation.cell.emulators.wsg50_answers import answer
from simulation.cell.emulators.wsg50_gripper import ACCELERATION_MM_S2, FORCE_N, SPEED_MM_S, STROKE_MM, Gripper

TICK_S = 0.005
_RELATIVE = 0x01
_INFO: tuple[Value, ...] = (1, 2, 0x4040, 50110)  # a WSG 50, hardware 2, firmware 4.0.4
_LIMITS: tuple[Value, ...] = (STROKE_MM, *SPEED_MM_S, *ACCELERATION_MM_S2, FORCE_N[0], FORCE_N[1], FORCE_N[1])
_MOTIONS = (Command.MOVE, Command.GRASP, Command.RELEASE)


@dataclass(slots=True)
class _Update:
    period_s: float
    on_change: bool
    due_s: float
    last: bytes = b""


@dataclass(slots=True)
class WsgCounters:
    """What went over the wire, for tests and the report."""

    requests: int = 0
    motions: int = 0
    relative_moves: int = 0
    fast_stops_by_disconnect: int = 0
    commands: list[str] = field(default_factory=list)


class Wsg50Emulator:
    """Server and clock of the gripper."""

    def __init__(self, gripper: Gripper, board: FaultBoard) -> None:
        self.gripper = gripper
        self.board = board
        self.counters = WsgCounters()
        self.connection: _Connection | None = None
        self._server: asyncio.Server | None = None
        self._clock: asyncio.Task[None] | None = None

    async def start(self, sock: socket.socket) -> None:
        """Listen on a bound socket and start the clock."""
        loop = asyncio.get_running_loop()
        self._server = await loop.create_server(lambda: _Connection(self), sock=sock)
        self._clock = asyncio.create_task(self._run())

    async def stop(self) -> None:
        """Close the connection and the server."""
        if self._clock is not None:
            self._clock.cancel()
            await asyncio.gather(self._clock, return_exceptions=True)
        if self.connection is not None:
            self.connection.abort()
        if self._server is not None:
            self._server.close()

    async def _run(self) -> None:
        last_s = time.monotonic()
        while True:
            await asyncio.sleep(TICK_S)
            now_s = time.monotonic()
            self.gripper.advance(min(now_s - last_s, 0.1))
            last_s = now_s
            if self.connection is not None:
                self.connection.update(now_s)
                if take(self.board.faults.wsg, "reset_now"):
                    self.connection.abort()

    def value(self, command: Command) -> tuple[Value, ...]:
        """The present answer to a state query."""
        gripper = self.gripper
        values: dict[Command, Value] = {
            Command.SYSTEM_STATE: int(gripper.system_state()),
            Command.GRASPING_STATE: int(gripper.state),
            Command.WIDTH: float(gripper.width_mm),
            Command.SPEED: float(gripper.speed_mm_s),
            Command.FORCE: float(gripper.force_n),
        }
        return (values[command],)


class _Connection(asyncio.Protocol):
    def __init__(self, emulator: Wsg50Emulator) -> None:
        self._emulator = emulator
        self._parser = StreamParser()
        self._transport: asyncio.Transport | None = None
        self._updates: dict[Command, _Update] = {}
        self._announced = False
        self._random = random.Random(0)

    # ---- the connection ---------------------------------------------------------------------------------------

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        if self._emulator.connection is not None or self._emulator.board.faults.wsg.refuse_connections:
            transport.abort()
            return
        self._transport = transport
        self._emulator.connection = self

    def data_received(self, data: bytes) -> None:
        for frame in self._parser.feed(data):
            self._handle(frame)

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002 asyncio's signature
        if self._emulator.connection is not self:
            return
        self._emulator.connection = None
        if not self._announced:
            self._emulator.counters.fast_stops_by_disconnect += 1
            self._emulator.gripper.fast_stop()

    def abort(self) -> None:
        """Cut the connection without a goodbye."""
        if self._transport is not None:
            self._transport.abort()

    # ---- requests ---------------------------------------------------------------------------------------------

    def _handle(self, frame: Frame) -> None:
        counters = self._emulator.counters
        counters.requests += 1
        if (more := answer(frame, self._emulator.gripper)) is not None:
            self._send(more)
            return
        try:
            request = decode_request(frame)
            status, values = self._execute(request)
        except WsgError as error:
            self._reply(frame.command, error.status)
            return
        if request.command not in STATE_QUERIES:
            counters.commands = [*counters.commands[-99:], request.command.name]
        self._reply(request.command, status, *values)

    def _finisher(self, command: Command) -> Callable[[Status], None]:
        return lambda status: self._reply(command, status)

    def _execute(self, request: Request) -> tuple[Status, tuple[Value, ...]]:
        command, values = request.command, request.values
        if command in STATE_QUERIES:
            return Status.SUCCESS, self._query(command, int(values[0]), int(values[1]))
        if command is Command.HOMING or command in _MOTIONS:
            self._emulator.counters.motions += 1
            return self._motion(command, values), ()
        if command is Command.ACKNOWLEDGE and values != (ACKNOWLEDGE_WORD,):
            return Status.INVALID_PARAMETER, ()
        if command is Command.DISCONNECT:
            self._announced = True
            self._emulator.gripper.stop()
        actions = {
            Command.STOP: self._emulator.gripper.stop,
            Command.FAST_STOP: self._emulator.gripper.fast_stop,
            Command.ACKNOWLEDGE: self._emulator.gripper.acknowledge,
        }
        if command in actions:
            return actions[command](), ()
        return self._settings(command, values)

    def _motion(self, command: Command, values: tuple[Value, ...]) -> Status:
        gripper, finish = self._emulator.gripper, self._finisher(command)
        if command is Command.HOMING:
            return gripper.home(int(values[0]), finish)
        if command is Command.MOVE:
            flags, width, speed = int(values[0]), float(values[1]), float(values[2])
            if flags & _RELATIVE:
                self._emulator.counters.relative_moves += 1
                width += gripper.width_mm
            return gripper.move(command, width, speed, finish, clamps=not flags & MoveFlag.STOP_ON_BLOCK)
        return gripper.move(command, float(values[0]), float(values[1]), finish)

    def _settings(self, command: Command, values: tuple[Value, ...]) -> tuple[Status, tuple[Value, ...]]:
        gripper = self._emulator.gripper
        if command is Command.SET_ACCELERATION:
            gripper.acceleration_mm_s2 = _clamped(float(values[0]), ACCELERATION_MM_S2)
        if command is Command.SET_FORCE_LIMIT:
            gripper.force_limit_n = _clamped(float(values[0]), FORCE_N)
        if command is Command.SET_SOFT_LIMITS:
            return gripper.limit(float(values[0]), float(values[1])), ()
        if command is Command.CLEAR_SOFT_LIMITS:
            gripper.soft_limits_mm = None
        answers: dict[Command, tuple[Value, ...]] = {
            Command.GET_ACCELERATION: (gripper.acceleration_mm_s2,),
            Command.GET_FORCE_LIMIT: (gripper.force_limit_n,),
            Command.GET_SOFT_LIMITS: gripper.soft_limits_mm or (0.0, STROKE_MM),
            Command.SYSTEM_INFO: _INFO,
            Command.SYSTEM_LIMITS: _LIMITS,
            Command.LOOP: values,
        }
        return Status.SUCCESS, answers.get(command, ())

    def _query(self, command: Command, flags: int, period_ms: int) -> tuple[Value, ...]:
        if flags & 1:
            period_s = max(period_ms, 10) / 1000.0
            self._updates[command] = _Update(period_s, bool(flags & 2), time.monotonic() + period_s)
        else:
            self._updates.pop(command, None)
        return self._emulator.value(command)

    # ---- replies ----------------------------------------------------------------------------------------------

    def update(self, now_s: float) -> None:
        """Send the auto-updates that are due."""
        for command, update in self._updates.items():
            if now_s < update.due_s:
                continue
            update.due_s = max(update.due_s + update.period_s, now_s)
            message = encode_reply(command, Status.SUCCESS, *self._emulator.value(command))
            if not (update.on_change and message == update.last):
                self._send(message)
            update.last = message

    def _reply(self, command: int, status: Status, *values: Value) -> None:
        self._send(encode_reply(command, status, *values))

    def _send(self, message: bytes) -> None:
        faults = self._emulator.board.faults.wsg
        if faults.silent:
            return
        if take(faults, "wrong_crc_next"):
            message = message[:-1] + bytes([message[-1] ^ 0x5A])
        if take(faults, "garbage_next"):
            message = self._random.randbytes(23) + message
        if faults.delay_ms:
            asyncio.get_running_loop().call_later(faults.delay_ms / 1000.0, self._write, message)
        else:
            self._write(message)

    def _write(self, message: bytes) -> None:
        if self._transport is not None and not self._transport.is_closing():
            self._transport.write(message)


def _clamped(value: float, limits: tuple[float, float]) -> float:
    """Settings beyond a limit are taken as the limit (comment in the vendor's own C library, as NALT ships it)."""
    return min(max(value, limits[0]), limits[1])
