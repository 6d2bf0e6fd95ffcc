"""A cell on a background event loop with a two-line physics, for tests of the emulators."""

import asyncio
import contextlib
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from robot_client.grippers.wsg50.codec import Reply, StreamParser, decode_reply, encode_request
from robot_client.grippers.wsg50.codes import Command, Status
from service.contract import Sensor
from simulation.cell.emulators.abb.motion import Pose, tool_down
from simulation.cell.live import LiveCell, Plant, bind_all
from simulation.cell.options import CellOptions
from simulation.scene.scene import APPROACH_MM
from simulation.scene.worlds import load_scene

GRASP_HEIGHT_MM = 30.0
STATE = {
    "gel": np.zeros((2, 20, 21, 3), np.float32),
    "slipping_share": np.zeros(2),
    "wrench_n_nmm": np.zeros(6),
    "in_hand": np.zeros(6),
    "block_motion": np.zeros((2, 4)),
    "in_contact": False,
    "inserted": False,
    "shortfalls": (),
    "grasp_lost": False,
}


class TwoLinePhysics:
    """The object follows the hand rigidly; deeper than the block tops off centre is contact."""

    relaxes, tilt_rad, scene = False, 0.0, load_scene("rectangle")

    def __init__(self):
        self.lost = self.broken = False
        self.grips = []

    def move_to(self, x_mm, y_mm, z_mm, yaw_deg):  # noqa: ARG002
        if self.broken:
            raise RuntimeError("no equilibrium")
        bottom = z_mm - GRASP_HEIGHT_MM
        blocked = bottom < 0 and abs(x_mm) > 2.5
        return SimpleNamespace(
            **STATE
            | {
                "object_error": (x_mm, yaw_deg),
                "bottom_z_mm": bottom,
                "in_contact": blocked,
                "inserted": bottom <= -20.0 and not blocked,
                "grasp_lost": self.lost,
            }
        )


def draw(gel, frame_seed, previous):
    """A grey image with a level given by the frame seed."""
    return np.full((320, 427, 3), frame_seed % 200, np.uint8)


def plant(physics: TwoLinePhysics, x_mm: float = 8.0, theta_deg: float = 6.0, fps: int = 30) -> Plant:
    start = Pose((x_mm, 0.0, APPROACH_MM + GRASP_HEIGHT_MM), tool_down(theta_deg))

    def regrasp(force_n, _part_n):
        physics.grips.append(force_n)
        return start

    return Plant(
        mechanics=physics,
        regrasp=regrasp,
        draw={"left": draw, "right": draw},
        start=start,
        part_width_mm=80.0,
        gap_width_mm=56.0,
        neighbours_stay=True,
        full_depth_mm=25.0,
        save_calibration=lambda _path: None,
        sensor=Sensor.load(),
        fps=fps,
    )


def forever(function):
    """Call until it raises."""
    while True:
        function()


class Bench:
    """The running cell and its addresses."""

    def __init__(self, options: CellOptions) -> None:
        self.physics = TwoLinePhysics()
        self.loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self.loop.run_forever, daemon=True)
        self._thread.start()
        self.cell = self.call(self._make, options)
        self.description = self.cell.description(Path("none"))
        self.run(self.cell.start())

    async def _make_async(self, make, *args):
        return make(*args)

    def _make(self, options):
        return LiveCell(options, plant(self.physics, fps=options.fps or 30), bind_all(options))

    def run(self, coroutine):
        return asyncio.run_coroutine_threadsafe(coroutine, self.loop).result(60.0)

    def call(self, function, *args):
        """Run a plain function on the cell's loop."""
        return self.run(self._make_async(function, *args))

    def faults(self, **sections):
        self.call(self.cell.board.update, sections)

    def wait(self, condition: Callable[[], bool], timeout_s: float = 30.0) -> None:
        """Wait until a condition on the cell holds."""
        end = time.monotonic() + timeout_s
        while not self.call(condition):
            assert time.monotonic() < end, "the cell never got there"
            time.sleep(0.005)

    def bring_up(self) -> None:
        """Motors on, RAPID running."""
        self.call(self.cell.cabinet.request_motors, True)
        self.wait(lambda: self.cell.cabinet.motors_on)
        self.call(self.cell.cabinet.request_start)
        self.wait(lambda: self.cell.cabinet.running)

    def close(self) -> None:
        self.run(self.cell.stop())
        self.loop.call_soon_threadsafe(self.loop.stop)
        self._thread.join(5.0)
        self.loop.close()


@contextlib.contextmanager
def bench(**options) -> Iterator[Bench]:
    made = Bench(CellOptions(**options))
    try:
        yield made
    finally:
        made.close()


class WsgClient:
    """The least that speaks the gripper's protocol."""

    def __init__(self, address: str) -> None:
        host, port = address.split(":")
        self.sock = socket.create_connection((host, int(port)), timeout=30.0)
        self.parser = StreamParser()
        self.waiting: list[Reply] = []

    def send(self, command: Command, *values) -> None:
        self.sock.sendall(encode_request(command, *values))

    def reply(self, command: Command | int) -> Reply:
        """The next reply of this command; others are dropped."""
        while True:
            while self.waiting:
                oldest = self.waiting.pop(0)
                if oldest.command == command:
                    return oldest
            data = self.sock.recv(4096)
            if not data:
                raise ConnectionError("closed")
            self.waiting += [decode_reply(frame) for frame in self.parser.feed(data)]

    def ask(self, command: Command, *values) -> Reply:
        self.send(command, *values)
        return self.reply(command)

    def do(self, command: Command, *values) -> Status:
        """A two-stage command to its end."""
        first = self.ask(command, *values)
        return self.reply(command).status if first.status is Status.CMD_PENDING else first.status

    def reset(self) -> None:
        """Vanish without a goodbye."""
        self.sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.sock.close()

    def close(self) -> None:
        with contextlib.suppress(OSError, ConnectionError):
            self.ask(Command.DISCONNECT)
        self.sock.close()
