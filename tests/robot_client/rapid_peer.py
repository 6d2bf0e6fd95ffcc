"""What TactileMotion.mod and TactileGuard.mod do, on loopback: two text servers, straight lines, a dead man."""

import asyncio
import math

from robot_client.geometry import TOOL_DOWN

STEP_S = 0.004


class RapidPeer:
    """Speaks the modules' text; the arm moves at the speed asked for and needs ``stop_s`` to stop."""

    def __init__(self, x_mm=5.0, z_mm=45.0, stop_s=0.06, silence_s=5.0):
        self.position = [x_mm, 0.0, z_mm]
        self.quaternion = list(TOOL_DOWN)
        self.stop_s, self.silence_s = stop_s, silence_s
        self.stop_flag = True
        self.at_rest = asyncio.Event()
        self.at_rest.set()
        self.stopped_by_silence = 0
        self.stop_from = None
        self.moves = []
        self.mute = False
        self.servers = []
        self.guard_writer = self.motion_writer = None

    async def start(self):
        for handler in (self.motion, self.guard):
            self.servers.append(await asyncio.start_server(handler, "127.0.0.1", 0))
        return [server.sockets[0].getsockname()[1] for server in self.servers]

    def close(self):
        for server in self.servers:
            server.close()
        for writer in (self.guard_writer, self.motion_writer):
            if writer is not None:
                writer.close()

    async def motion(self, reader, writer):
        self.motion_writer = writer
        try:
            while True:
                fields = (await reader.readuntil(b"#")).decode()[:-1].split()
                if fields[0] == "Q":
                    break
                number, numbers = fields[1], [float(value) for value in fields[2:]]
                self.moves.append(numbers)
                result = await self.travel(numbers[:3], numbers[3:7], numbers[7])
                writer.write(f"{result} {number}#".encode())
        except (asyncio.IncompleteReadError, asyncio.CancelledError, ConnectionError):
            self.stop_flag = True

    async def travel(self, target, quaternion, speed):
        """By the peer's own clock, which a stalled machine stops too, as it stops whoever would stop the arm."""
        start, now_s = list(self.position), 0.0
        turn = 2.0 * math.degrees(
            math.acos(min(1.0, abs(sum(a * b for a, b in zip(quaternion, self.quaternion, strict=True)))))
        )
        first = list(self.quaternion)
        way = max(math.dist(start, target), turn)
        stop_at = None
        self.at_rest.clear()
        while True:
            if self.stop_flag and stop_at is None:
                stop_at, self.stop_from = now_s + self.stop_s, list(self.position)
            if stop_at is not None and now_s >= stop_at:
                self.at_rest.set()
                return "S"
            share = 1.0 if way == 0 else min(1.0, now_s * speed / way)
            self.position = [a + (b - a) * share for a, b in zip(start, target, strict=True)]
            mixed = [a + (b - a) * share for a, b in zip(first, quaternion, strict=True)]
            self.quaternion = [c / math.hypot(*mixed) for c in mixed]
            if share >= 1.0:
                self.at_rest.set()
                return "D"
            await asyncio.sleep(STEP_S)
            now_s += STEP_S

    async def guard(self, reader, writer):
        self.guard_writer = writer
        try:
            while True:
                text = await asyncio.wait_for(reader.readuntil(b"#"), self.silence_s)
                kind, number = text.decode()[:-1].split()
                self.stop_flag = {"S": True, "R": False, "H": self.stop_flag}[kind]
                values = [f"{v:.2f}" for v in self.position] + [f"{v:.5f}" for v in self.quaternion]
                if not self.mute:
                    moving = int(not self.at_rest.is_set())
                    writer.write(f"P {number} {' '.join(values)} {moving} {int(self.stop_flag)}#".encode())
        except TimeoutError:
            self.stop_flag = True
            self.stopped_by_silence += 1
            writer.close()
        except (asyncio.IncompleteReadError, asyncio.CancelledError, ConnectionError):
            self.stop_flag = True
