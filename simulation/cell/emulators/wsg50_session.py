"""One client of the emulated WSG-50 over any link: its requests, their answers, its auto-updates.

Cited by section: [M] WSG Command Set Reference Manual, firmware 4.0.0, July 2015, the manual of the firmware that this
gripper reports.
"""

import asyncio
import random
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
from simulation.cell.emulators.wsg50_answers import foreign_status
from simulation.cell.emulators.wsg50_gripper import ACCELERATION_MM_S2, FORCE_N, SPEED_MM_S, STROKE_MM, Gripper

MAX_LOOP_BYTES = 256  # [M] 3.1.1
_RELATIVE = 0x01
_INFO: tuple[Value, ...] = (1, 2, 0x4040, 50110)  # [M] 3.5.1: a WSG 50, hardware 2, firmware 4.0.4
_LIMITS: tuple[Value, ...] = (STROKE_MM, *SPEED_MM_S, *ACCELERATION_MM_S2, FORCE_N[0], FORCE_N[1], FORCE_N[1])
_MOTIONS = (Command.MOVE, Command.GRASP, Command.RELEASE)


@dataclass(slots=True)
class WsgCounters:
    """Counts of what went over the wire, for tests."""

    relative_moves: int = 0
    fast_stops_by_disconnect: int = 0
    commands: list[str] = field(default_factory=list)


@dataclass(slots=True)
class _Update:
    period_s: float
    on_change: bool
    due_s: float
    last: bytes = b""


class Session:
    """Requests in, answers out through ``write``; ``leaves``: whether this link's end can be announced."""

    def __init__(
        self,
        gripper: Gripper,
        board: FaultBoard,
        counters: WsgCounters,
        write: Callable[[bytes], None],
        *,
        leaves: bool,
    ) -> None:
        self.announced = False
        self._gripper, self._board, self._counters = gripper, board, counters
        self._write, self._leaves = write, leaves
        self._parser = StreamParser()
        self._updates: dict[Command, _Update] = {}
        self._random = random.Random(0)

    def feed(self, data: bytes) -> None:
        """Accept bytes from the client and answer every frame in them."""
        for frame in self._parser.feed(data):
            if self.announced:  # [M] 3.1.2: it waits for the disconnection
                self._reply(frame.command, Status.ACCESS_DENIED)
            elif (status := foreign_status(frame, self._gripper.state)) is not None:
                self._reply(frame.command, status)
            else:
                self._handle(frame)

    def update(self, now_s: float) -> None:
        for command, update in self._updates.items():
            if now_s < update.due_s:
                continue
            update.due_s = max(update.due_s + update.period_s, now_s)
            message = encode_reply(command, Status.SUCCESS, *self._value(command))
            if not (update.on_change and message == update.last):
                self._send(message)
            update.last = message

    # ---- requests -------------------------------------------------------------------------------------------------

    def _handle(self, frame: Frame) -> None:
        try:
            request = decode_request(frame)
            status, values = self._execute(request)
        except WsgError as error:
            self._reply(frame.command, error.status)
            return
        if request.command not in STATE_QUERIES:
            self._counters.commands = [*self._counters.commands[-99:], request.command.name]
        self._reply(request.command, status, *values)

    def _execute(self, request: Request) -> tuple[Status, tuple[Value, ...]]:
        command, values, gripper = request.command, request.values, self._gripper
        if command in STATE_QUERIES:
            return Status.SUCCESS, self._query(command, int(values[0]), int(values[1]))
        if command is Command.HOMING or command in _MOTIONS:
            return self._motion(command, values), ()
        if command is Command.ACKNOWLEDGE and values != (ACKNOWLEDGE_WORD,):
            return Status.CMD_FORMAT_ERROR, ()  # [M] 3.2.5
        if command is Command.DISCONNECT:
            return self._leave(), ()
        actions = {
            Command.STOP: gripper.stop,  # [M] 3.2.3
            Command.FAST_STOP: gripper.fast_stop,  # [M] 3.2.4
            Command.ACKNOWLEDGE: gripper.acknowledge,  # [M] 3.2.5
        }
        if command in actions:
            return actions[command](), ()
        return self._settings(command, values)

    def _leave(self) -> Status:
        """[M] 3.1.2: motions are aborted; not available on a connectionless link."""
        if not self._leaves:
            return Status.NOT_AVAILABLE
        self.announced = True
        return self._gripper.stop()

    def _motion(self, command: Command, values: tuple[Value, ...]) -> Status:
        """[M] 3.2.1, 3.2.2, 3.2.6, 3.2.7."""
        gripper = self._gripper

        def finish(status: Status) -> None:
            self._reply(command, status)

        if command is Command.HOMING:
            return gripper.home(int(values[0]), finish)
        if command is Command.MOVE:
            flags, width, speed = int(values[0]), float(values[1]), float(values[2])
            if flags & _RELATIVE:
                self._counters.relative_moves += 1
                width += gripper.width_mm
            return gripper.move(command, width, speed, finish, clamps=not flags & MoveFlag.STOP_ON_BLOCK)
        return gripper.move(command, float(values[0]), float(values[1]), finish)

    def _settings(self, command: Command, values: tuple[Value, ...]) -> tuple[Status, tuple[Value, ...]]:
        """[M] 3.3.1 to 3.3.7 (acceleration and force beyond a limit are clamped to it), 3.1.1, 3.5.1, 3.5.4."""
        gripper = self._gripper
        if command is Command.SET_ACCELERATION:
            gripper.acceleration_mm_s2 = _clamped(float(values[0]), ACCELERATION_MM_S2)
        if command is Command.SET_FORCE_LIMIT:
            gripper.force_limit_n = _clamped(float(values[0]), FORCE_N)
        if command is Command.SET_SOFT_LIMITS:
            return gripper.limit(float(values[0]), float(values[1])), ()
        if command is Command.CLEAR_SOFT_LIMITS:
            gripper.soft_limits_mm = None
        if command is Command.GET_SOFT_LIMITS and gripper.soft_limits_mm is None:
            return Status.NOT_AVAILABLE, ()
        if command is Command.LOOP and len(bytes(values[0])) > MAX_LOOP_BYTES:  # type: ignore[arg-type]
            return Status.CMD_FORMAT_ERROR, ()
        answers: dict[Command, tuple[Value, ...]] = {
            Command.GET_ACCELERATION: (gripper.acceleration_mm_s2,),
            Command.GET_FORCE_LIMIT: (gripper.force_limit_n,),
            Command.GET_SOFT_LIMITS: gripper.soft_limits_mm or (),
            Command.SYSTEM_INFO: _INFO,
            Command.SYSTEM_LIMITS: _LIMITS,
            Command.LOOP: values,
        }
        return Status.SUCCESS, answers.get(command, ())

    def _query(self, command: Command, flags: int, period_ms: int) -> tuple[Value, ...]:
        """[M] 3.4.1: no shorter period than 10 ms."""
        if flags & 1:
            period_s = max(period_ms, 10) / 1000.0
            self._updates[command] = _Update(period_s, bool(flags & 2), time.monotonic() + period_s)
        else:
            self._updates.pop(command, None)
        return self._value(command)

    def _value(self, command: Command) -> tuple[Value, ...]:
        """The present answer to a state query: [M] 3.4.1, 3.4.2, 3.4.4 (no width before homing), 3.4.5, 3.4.6."""
        gripper = self._gripper
        values: dict[Command, Value] = {
            Command.SYSTEM_STATE: int(gripper.system_state()),
            Command.GRASPING_STATE: int(gripper.state),
            Command.WIDTH: float(gripper.width_mm) if gripper.homed else 0.0,
            Command.SPEED: float(gripper.speed_mm_s),
            Command.FORCE: float(gripper.force_n),
        }
        return (values[command],)

    # ---- replies --------------------------------------------------------------------------------------------------

    def _reply(self, command: int, status: Status, *values: Value) -> None:
        self._send(encode_reply(command, status, *values))

    def _send(self, message: bytes) -> None:
        faults = self._board.faults.wsg
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


def _clamped(value: float, limits: tuple[float, float]) -> float:
    return min(max(value, limits[0]), limits[1])
