"""The controller without EGM: TactileMotion.mod and TactileGuard.mod as two text servers on the cabinet's arm.

A move walks the arm's target along a straight line. The stop flag, raised on request or by the guard's own dead-man
switch, halts it ``REACTION_S`` later on the controller's stop ramp. Time is the controller's, so a stalled machine
stalls the arm too.

A stop of the controller closes no socket: the guard is a background task and answers on, and the motion server stands
in its move until main begins anew, which closes the connection of the run before.
"""

import asyncio
import math
import socket
from collections.abc import AsyncIterator
from dataclasses import dataclass, field

from robot_client.insertion.geometry import normalised
from robot_client.robots.abb_rapid.codec import MAX_TEXT, TextParser
from simulation.cell.emulators.abb.cabinet import Cabinet
from simulation.cell.emulators.abb.motion import Pose, rotated, rotation_between

SILENCE_S = 0.1  # silenceLimit of TactileGuard.mod
TOP_SPEED_MM_S = 80.0  # topSpeed and turnSpeed of TactileMotion.mod
TURN_DEG_S = 55.0
REACTION_S = 0.04  # from the flag to the brake: an assumption; the modules have not yet run on a controller
_CYCLE_S = 0.004


@dataclass(slots=True)
class Travel:
    """One move under way: its ends, its duration and its length."""

    number: str
    start: Pose
    end: Pose
    duration_s: float
    walked_s: float = 0.0
    stopping_s: float | None = None  # since the flag went up


@dataclass
class RapidServers:
    """The two servers; ``cycle`` is called every 4 ms of the controller's clock."""

    cabinet: Cabinet
    silence_s: float = SILENCE_S
    stop: bool = True
    mute: bool = False
    moves: list[str] = field(default_factory=list)
    stopped_by_silence: int = 0
    motion_port: int = 0
    guard_port: int = 0
    _servers: list[asyncio.Server] = field(default_factory=list)
    _motion: asyncio.StreamWriter | None = None
    _guard: asyncio.StreamWriter | None = None
    _travel: Travel | None = None
    _silent_s: float = 0.0
    _ran: bool = False

    async def start(self, motion: socket.socket, guard: socket.socket) -> None:
        self.motion_port, self.guard_port = motion.getsockname()[1], guard.getsockname()[1]
        self._servers = [
            await asyncio.start_server(self._serve_motion, sock=motion),
            await asyncio.start_server(self._serve_guard, sock=guard),
        ]

    async def close(self) -> None:
        for server in self._servers:
            server.close()
        self.hang_up()

    def hang_up(self, *, motion: bool = True, guard: bool = True) -> None:
        for wanted, writer in ((motion, self._motion), (guard, self._guard)):
            if wanted and writer is not None:
                writer.close()

    @property
    def moving(self) -> bool:
        return self._travel is not None

    # ---- time -------------------------------------------------------------------------------------------------

    def cycle(self) -> None:
        """Advance by 4 ms."""
        if self.cabinet.running and not self._ran:
            self.stop = True
            self.hang_up(guard=False)
        self._ran = self.cabinet.running
        if self._guard is not None:
            self._silent_s += _CYCLE_S
            if self._silent_s > self.silence_s and not self._guard.is_closing():
                self.stop = True
                self.stopped_by_silence += 1
                self.hang_up(motion=False)
        if not self._ran:
            self._travel = None  # nothing answers it any more: each start here is from main
        elif self._travel is not None:
            self._walk(self._travel)

    def _walk(self, travel: Travel) -> None:
        arm = self.cabinet.arm
        if self.stop and travel.stopping_s is None:
            travel.stopping_s = 0.0
        if travel.stopping_s is not None:
            travel.stopping_s += _CYCLE_S
            arm.braking = arm.braking or travel.stopping_s >= REACTION_S
            if arm.braking and arm.at_rest:
                arm.hold()
                self._end(travel, "S")
                return
        if arm.braking:
            return
        travel.walked_s = min(travel.walked_s + _CYCLE_S, travel.duration_s)
        share = travel.walked_s / travel.duration_s
        start, end = travel.start.position_mm, travel.end.position_mm
        x, y, z = (a + (b - a) * share for a, b in zip(start, end, strict=True))
        a, b, c = rotation_between(travel.start.quaternion, travel.end.quaternion)
        arm.target = Pose((x, y, z), rotated(travel.start.quaternion, (a * share, b * share, c * share)))
        if share >= 1.0 and arm.at_rest:
            self._end(travel, "D")

    def _end(self, travel: Travel, result: str) -> None:
        self._travel = None
        self._answer(self._motion, f"{result} {travel.number}")

    # ---- text -------------------------------------------------------------------------------------------------

    def _answer(self, writer: asyncio.StreamWriter | None, text: str) -> None:
        if writer is not None and not writer.is_closing() and not self.mute:
            writer.write(f"{text}#".encode())

    async def _serve_motion(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if not self.cabinet.running:  # nobody listens
            writer.close()
            return
        self._motion = writer
        async for text in self._requests(reader, writer):
            if self.cabinet.running:
                self._on_move(text)
        self._motion, self.stop = None, True

    async def _serve_guard(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._guard, self._silent_s = writer, 0.0
        async for text in self._requests(reader, writer):
            self._silent_s = 0.0
            self._on_guard(text)
        self._guard, self.stop = None, True

    async def _requests(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> AsyncIterator[str]:
        parser = TextParser()
        try:
            while data := await reader.read(MAX_TEXT):
                for text in parser.feed(data):
                    yield text
        except OSError:
            pass
        finally:
            writer.close()

    def _on_move(self, text: str) -> None:
        fields = text.split()
        try:
            if len(fields) != 10 or fields[0] != "M":
                raise ValueError
            x, y, z, *q, speed = (float(value) for value in fields[2:])
            end = Pose((x, y, z), normalised((q[0], q[1], q[2], q[3])))
        except ValueError:
            self._answer(self._motion, "E 0 format")
            return
        if not 0.0 < speed <= TOP_SPEED_MM_S:
            self._answer(self._motion, f"E {fields[1]} speed")
            return
        self.moves.append(text)
        start = self.cabinet.arm.pose
        turn_deg = math.degrees(math.hypot(*rotation_between(start.quaternion, end.quaternion)))
        duration_s = max(math.dist(start.position_mm, end.position_mm) / speed, turn_deg / min(speed, TURN_DEG_S))
        share = max(1, self.cabinet.speed_ratio) / 100.0
        self._travel = Travel(fields[1], start, end, max(duration_s / share, _CYCLE_S))
        self.cabinet.arm.hold()
        self.cabinet.arm.braking = self.stop  # raised before the start: nothing moves

    def _on_guard(self, text: str) -> None:
        kind, _, number = text.partition(" ")
        if not number.isdigit() or kind not in ("H", "R", "S"):
            return
        self.stop = {"S": True, "R": False, "H": self.stop}[kind]
        pose = self.cabinet.arm.pose
        position = " ".join(f"{value:.2f}" for value in pose.position_mm)
        quaternion = " ".join(f"{value:.5f}" for value in pose.quaternion)
        self._answer(self._guard, f"P {number} {position} {quaternion} {int(self.stop)}")
