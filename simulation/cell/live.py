"""The cell in real time on loopback: robot, gripper and cameras as sockets, one physics behind them, and ground truth.

Everything listens on 127.0.0.1 only. The arm starts 10 mm above the approach pose with the object standing between its
open fingers, motors off and RAPID stopped: the client starts them.
"""

import asyncio
import contextlib
import math
import signal
import socket
import sys
import time
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from reporting.files import write_json
from service.contract import FINGERS, Sensor
from simulation.cell.admin import create_admin
from simulation.cell.cameras import CameraFeed, Draw, failure
from simulation.cell.config import client_config
from simulation.cell.emulators.abb.cabinet import Cabinet
from simulation.cell.emulators.abb.egm import EgmEmulator
from simulation.cell.emulators.abb.frames import CellFrames
from simulation.cell.emulators.abb.motion import Follower, MotionLimits, Pose
from simulation.cell.emulators.abb.rapid import RapidServers
from simulation.cell.emulators.abb.rws import Gate, create_app
from simulation.cell.emulators.camera import CameraEmulator
from simulation.cell.emulators.faults import FaultBoard
from simulation.cell.emulators.net import HOST, HttpServer, bind_tcp, bind_udp, free_port, port_of
from simulation.cell.emulators.stopwatch import StopWatch
from simulation.cell.emulators.wsg50 import Wsg50Emulator
from simulation.cell.emulators.wsg50_gripper import Gripper
from simulation.cell.film import Course
from simulation.cell.options import CellOptions
from simulation.cell.world import HeldPart, World
from simulation.closed_loop.lockstep import CREEP_ALLOWANCE_MM
from simulation.scene.state import Cell

LIFT_MM = 10.0  # height of the start above the approach pose
TRACE_N = 30_000  # TCP heights, 250 per second: two minutes


class Plant(NamedTuple):
    """The models behind the devices: physics, optics, and the numbers that a client needs."""

    mechanics: Cell
    regrasp: Callable[[float, int], Pose]  # (grip force, number of the object) -> pose of the TCP afterwards
    draw: dict[str, Draw]
    start: Pose  # TCP at the approach pose
    part_width_mm: float
    gap_width_mm: float
    neighbours_stay: bool
    full_depth_mm: float  # of a descent from there
    save_calibration: Callable[[Path], None]
    sensor: Sensor
    fps: float
    dropped_share: float = 0.0  # share of camera frames dropped, from the scene


class Sockets(NamedTuple):
    """Bound sockets of all devices."""

    egm: socket.socket
    rws: socket.socket
    gripper: socket.socket
    left: socket.socket
    right: socket.socket
    admin: socket.socket
    rapid_motion: socket.socket
    rapid_guard: socket.socket
    gripper_udp: socket.socket


def bind_all(options: CellOptions) -> Sockets:
    """Bind every port before anything slow happens; raise BusyPortError naming the device."""
    wanted = (
        (options.rws_port, "RWS"),
        (options.gripper_port, "the gripper"),
        (options.camera_left_port, "the left camera"),
        (options.camera_right_port, "the right camera"),
        (options.admin_port, "the admin server"),
        (0, "the RAPID motion server"),
        (0, "the RAPID guard"),
    )
    with contextlib.ExitStack() as taken:
        bound = [taken.enter_context(bind_udp(0, "EGM"))]
        bound += [taken.enter_context(bind_tcp(port, name)) for port, name in wanted]
        bound.append(taken.enter_context(bind_udp(options.gripper_udp_port, "the gripper")))
        taken.pop_all()
    return Sockets(*bound)


@dataclass
class LiveCell:
    """All devices of one cell on the running event loop."""

    options: CellOptions
    plant: Plant
    sockets: Sockets
    board: FaultBoard = field(default_factory=FaultBoard)

    def __post_init__(self) -> None:
        options, plant = self.options, self.plant
        x, y, z = plant.start.position_mm
        at_start = Pose((x, y, z + LIFT_MM), plant.start.quaternion)
        limits = MotionLimits(lag_s=options.egm_lag_ms / 1000.0)
        self.cabinet = Cabinet(Follower(at_start, limits), self.board)
        self.frames = CellFrames()
        self.guide_port = options.egm_guide_port or free_port(socket.SOCK_DGRAM)
        self.egm = EgmEmulator(self.cabinet, self.frames, self.guide_port)
        self.stop_watch = StopWatch(self.cabinet)
        self.rapid = RapidServers(self.cabinet)
        self.egm.on_cycle += [self.rapid.cycle, self.stop_watch, self._set_lag, self._note_height]
        self.trace: deque[tuple[int, float]] = deque(maxlen=TRACE_N)
        self.gate = Gate(self.board)
        self.rws = HttpServer(create_app(self.cabinet, self.frames, self.gate), self.sockets.rws)
        self.gate.abort = self.rws.abort
        self.world = World(plant.mechanics, plant.regrasp, self._pose, sensor=plant.sensor, fps=plant.fps, held=False)
        self.world.on_unsolved = self._supervise
        self.part = HeldPart(self.world, plant.part_width_mm, self._pose, at_start, fed=options.feed)
        self.gripper = Gripper(self.part, self.board, holding=False)
        self.wsg = Wsg50Emulator(self.gripper, self.board, options.gripper_udp_remote_port)
        self.cameras = {finger: CameraEmulator(finger, self.board, plant.dropped_share) for finger in FINGERS}
        readings = {"truth": self.truth, "glance": self.glance, "trace": self.way}
        self.admin = HttpServer(create_admin(readings, self.board), self.sockets.admin)
        self.feeds: list[CameraFeed] = []
        self.course = Course(self.world, plant.fps)
        self.world.on_exposure(self.course)
        self._loop: asyncio.AbstractEventLoop | None = None

    def _pose(self) -> Pose:
        return self.cabinet.arm.pose

    def _supervise(self, why: str) -> None:
        """Motion supervision: a load that the physics cannot bear ends in a protective stop, as a collision does."""

        def stop() -> None:
            self.cabinet.note(3, 50204, f"Motion supervision: {why}")
            self.board.update({"robot": {"protective_stop": True}})

        if self._loop is not None:
            self._loop.call_soon_threadsafe(stop)

    def _note_height(self) -> None:
        self.trace.append((time.monotonic_ns(), self.cabinet.arm.pose.position_mm[2]))

    def _set_lag(self) -> None:
        lag_ms = self.board.faults.robot.egm_lag_ms
        wanted = (lag_ms or self.options.egm_lag_ms) / 1000.0
        if not math.isclose(self.cabinet.arm.limits.lag_s, wanted):
            self.cabinet.arm.limits = MotionLimits(lag_s=wanted)

    async def start(self) -> None:
        loop = self._loop = asyncio.get_running_loop()
        await asyncio.to_thread(self.world.warm)
        for index, finger in enumerate(FINGERS):
            feed = CameraFeed(self.cameras[finger], index, self.plant.draw[finger], loop)
            self.world.on_exposure(feed.expose)
            self.feeds.append(feed)
            await self.cameras[finger].start(self.sockets.left if finger == "left" else self.sockets.right)
        await self.rapid.start(self.sockets.rapid_motion, self.sockets.rapid_guard)
        await self.egm.start(self.sockets.egm)
        await self.wsg.start(self.sockets.gripper, self.sockets.gripper_udp)
        await self.rws.start()
        await self.admin.start()
        for feed in self.feeds:
            feed.start()
        self.world.start()

    async def stop(self) -> None:
        """Stop all devices and threads."""
        await asyncio.to_thread(self._stop_threads)
        await self.rapid.close()
        await self.egm.stop()
        await self.wsg.stop()
        for camera in self.cameras.values():
            await camera.stop()
        self.rws.stop()
        self.admin.stop()

    def _stop_threads(self) -> None:
        self.world.stop()
        for feed in self.feeds:
            feed.stop()

    async def watch(self) -> None:
        """Run until one of the cell's threads fails; then raise its error."""
        while (error := failure(self.world, *self.feeds)) is None:  # noqa: ASYNC110 set by threads
            await asyncio.sleep(0.2)
        raise RuntimeError(f"the cell's physics or optics failed: {error}") from error

    # ---- what clients and the admin port get ------------------------------------------------------------------

    def description(self, calibration: Path) -> dict[str, Any]:
        """Contents of cell.json: addresses, calibration, and what a client may know of the task."""
        x, y, z = self.plant.start.position_mm
        ports = [port_of(s) for s in self.sockets]
        urls = {f: f"http://{HOST}:{p}/stream.mjpg" for f, p in zip(FINGERS, ports[3:5], strict=True)}
        return {
            "egm_guide_port": self.guide_port,
            "rws_url": f"http://{HOST}:{ports[1]}",
            "rapid": {"host": HOST, "motion_port": ports[6], "guard_port": ports[7]},
            "gripper": f"{HOST}:{ports[2]}",
            "gripper_udp": f"{HOST}:{ports[8]}",
            "cameras": urls,
            "admin_url": f"http://{HOST}:{ports[5]}",
            "calibration": str(calibration),
            "object": self.options.object,
            "gap_width_mm": self.plant.gap_width_mm,
            "neighbours_stay": self.plant.neighbours_stay,
            "expected_depth_mm": self.plant.full_depth_mm,
            "creep_allowance_mm": CREEP_ALLOWANCE_MM,
            "approach": {"x_mm": x, "y_mm": y, "z_mm": z, "yaw_deg": self.plant.start.yaw_deg},
            "home": {"x_mm": x, "y_mm": y, "z_mm": z + LIFT_MM, "yaw_deg": self.plant.start.yaw_deg},
            "fps": self.plant.fps,
        }

    async def way(self) -> list[tuple[int, float]]:
        """Heights of the TCP in mm over the machine's steady clock in ns, one entry per cycle of the arm."""
        return list(self.trace)

    async def glance(self) -> dict[str, Any]:
        """The arm's pose, and whether the object touches anything."""
        state = self.world.state
        return {"z_mm": self.cabinet.arm.pose.position_mm[2], "touches": state is not None and bool(state.in_contact)}

    async def truth(self) -> dict[str, Any]:
        """Data that only a simulator knows."""
        arm, state = self.cabinet.arm, self.world.state
        truth: dict[str, Any] = {
            "tcp": {"position_mm": arm.pose.position_mm, "yaw_deg": arm.pose.yaw_deg, "tilt_deg": arm.pose.tilt_deg},
            "moving": not arm.at_rest,
            "controller": {"state": self.cabinet.state, "running": self.cabinet.running, "egm": self.cabinet.egm},
            "gripper": {"state": self.gripper.state.name, "width_mm": self.gripper.width_mm, "held": self.world.held},
            "stops": [stop.as_dict() for stop in self.stop_watch.stops],
            "course": asdict(self.world.course),
            "camera_drawn_ns": [feed.drawn_ns for feed in self.feeds],
        }
        if state is not None:
            x_mm, theta_deg = state.object_error
            truth["object"] = {
                "x_mm": float(x_mm),
                "theta_deg": float(theta_deg),
                "bottom_z_mm": float(state.bottom_z_mm),
                "in_hand": [float(v) for v in state.in_hand],
                "in_contact": bool(state.in_contact),
                "inserted": bool(state.inserted),
                "shortfalls": list(state.shortfalls),
                "grasp_lost": bool(state.grasp_lost),
                "wrench_n_nmm": [float(v) for v in state.wrench_n_nmm],
                "slipping_share": [float(v) for v in state.slipping_share],
                "block_motion": np.asarray(state.block_motion, float).tolist(),
            }
        return truth


async def serve(options: CellOptions, plant: Plant, sockets: Sockets) -> int:
    """Run a cell until SIGINT or SIGTERM (0) or until its physics fails (1)."""
    sys.setswitchinterval(0.001)  # the 4 ms cycle must not wait 5 ms for a thread that draws
    cell = LiveCell(options, plant, sockets)
    ended = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, ended.set)
    await cell.start()
    options.out.mkdir(parents=True, exist_ok=True)
    calibration = (options.out / "calibration.toml").resolve()
    plant.save_calibration(calibration)
    facts = cell.description(calibration)
    (options.out / "cell.toml").write_text(client_config(facts, "http://127.0.0.1:8000", None))
    write_json(options.out / "cell.json", facts)
    print(f"cell: ready, {options.object} at x {options.x_mm:+.1f} mm, yaw {options.theta_deg:+.1f} deg", flush=True)
    watch, end = asyncio.create_task(cell.watch()), asyncio.create_task(ended.wait())
    await asyncio.wait({watch, end}, return_when=asyncio.FIRST_COMPLETED)
    failed = watch.done() and watch.exception()
    if failed:
        print(f"cell: {watch.exception()}", file=sys.stderr)
    for task in (watch, end):
        task.cancel()
    await cell.stop()
    cell.course.save(options.out / "course.npz", plant.gap_width_mm)
    return 1 if failed else 0
