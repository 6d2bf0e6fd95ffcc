"""A small live cell for the tests: the emulated robot and gripper, and a decision service that knows the truth.

Everything runs on the test's event loop over real sockets. Contact is geometry, as exact as the tests need it.
"""

import asyncio
import contextlib
import socket
import time
from dataclasses import dataclass, field

from websockets.asyncio.server import serve
from websockets.exceptions import ConnectionClosed

from robot_client.cli.insert import live_ports, make_plan
from robot_client.insertion.lease import PAUSE_S
from robot_client.session.recorder import Recorder
from robot_client.session.report import Report
from robot_client.session.runner import Runner
from robot_client.settings import Settings, _merged, load_settings
from service.contract import wire
from service.contract.replies import beat, clock
from service.contract.token import keep_token, state_folder
from simulation.cell.emulators.abb.cabinet import Cabinet, Delays
from simulation.cell.emulators.abb.egm import EgmEmulator
from simulation.cell.emulators.abb.frames import CellFrames
from simulation.cell.emulators.abb.motion import Follower, MotionLimits, Pose, tool_down
from simulation.cell.emulators.abb.rapid import RapidServers
from simulation.cell.emulators.abb.rws import Gate, create_app
from simulation.cell.emulators.faults import FaultBoard
from simulation.cell.emulators.net import HttpServer, bind_tcp, bind_udp, free_port, port_of
from simulation.cell.emulators.wsg50 import Wsg50Emulator
from simulation.cell.emulators.wsg50_gripper import Gripper
from tests.robot_client.robots.abb_rws.omnicore import Basic, create_app2

# A busy machine may stop this process, emulators included, for long: who tests a time sets it.
_RWS_TIMES = ("request_timeout_s", "motors_timeout_s", "start_timeout_s", "stop_timeout_s")
FRAME_S = 0.03
CONTACT_MM, CLEARANCE_MM, CLEARANCE_DEG = 6.0, 2.5, 3.5
LIMITS = wire.Limits(max_dx_mm=15.0, max_dtheta_deg=15.0, max_frame_age_ms=250.0)


class Part:
    """A 50 mm wide object between the fingers."""

    def __init__(self, present=True):
        self.present = present

    def width_mm(self):
        return 50.0 if self.present else None

    def gripped(self, force_n):
        self.force_n = force_n

    def released(self):
        pass

    def lost(self):
        return False


@dataclass
class TruthfulService:
    """Speaks the wire protocol; watches the emulated arm for contact and answers with 0.7 times the true error.

    ``on_message`` sees each client message first and may return replies of its own instead (None: as usual).
    """

    cabinet: Cabinet
    approach_z_mm: float = 35.0
    share: float = 0.7
    received: list = field(default_factory=list)
    slips_ns: list = field(default_factory=list)
    on_message: object = None
    delays_s: dict = field(default_factory=dict)
    mute: bool = False
    silent_heartbeat: bool = False
    sees: bool = True
    offset: tuple = (0.0, 0.0)
    connection: object = None
    _attempt: int = 0
    _watching: bool = False

    @property
    def error(self):
        pose = self.cabinet.arm.pose
        return pose.position_mm[0] + self.offset[0], pose.yaw_deg + self.offset[1]

    async def handle(self, connection):
        self.connection = connection
        watcher = asyncio.create_task(self._watch())
        try:
            async for text in connection:
                message = wire.parse_client(text)
                if not isinstance(message, wire.ClientHeartbeat | wire.Telemetry | wire.Episode):
                    self.received.append(message)
                await asyncio.sleep(self.delays_s.get(message.type, 0.0))
                replies = self.on_message(message) if self.on_message else None
                for reply in self._answer(message) if replies is None else replies:
                    await self.say(reply)
        except (ConnectionClosed, OSError):
            pass  # the client or the test cut the connection
        finally:
            watcher.cancel()

    async def say(self, reply):
        if not self.mute and self.connection is not None:
            await self.connection.send(reply if isinstance(reply, str | bytes) else reply.model_dump_json())

    def slip(self, **changes):
        values = {"attempt": self._attempt, "finger": "left", "frame_seq": 1, "captured_ns": 1, "age_ms": 5.0}
        return wire.Slip(insertion_id=self.insertion_id, score=8.0, reason="test", **{**values, **changes})

    def correction(self, attempt, **changes):
        x, theta = self.error
        values = {"dx_mm": -self.share * x, "dtheta_deg": -self.share * theta}
        return wire.Correction(
            insertion_id=self.insertion_id,
            attempt=attempt,
            class_probabilities={"5": 0.9, "2": 0.1},
            estimate=wire.Estimate(dx_mm=x, dtheta_deg=theta),
            confidence=0.9,
            controller="heuristic",
            reason="truth",
            latency_ms={"infer": 2.0},
            **{**values, **changes},
        )

    def hello(self, **changes):
        values = {"models": (), "cameras": (), "controller": "heuristic", "limits": LIMITS}
        return wire.ServiceHello(insertion_id=self.insertion_id, **{**values, **changes})

    def watching(self, **changes):
        now_ns = time.monotonic_ns()
        values = {"attempt": self._attempt, "frame_captured_ns": now_ns, "judged_ns": now_ns}
        return wire.Watching(insertion_id=self.insertion_id, **{**values, **changes})

    async def _watch(self):
        watched_s = 0.0
        while True:
            await asyncio.sleep(0.002)
            if self._watching and self.sees and time.monotonic() - watched_s > FRAME_S:
                watched_s = time.monotonic()
                await self.say(self.watching())
            x, theta = self.error
            depth = self.approach_z_mm - self.cabinet.arm.pose.position_mm[2]
            blocked = abs(x) > CLEARANCE_MM or abs(theta) > CLEARANCE_DEG
            if self._watching and blocked and depth >= CONTACT_MM:
                self._watching = False
                self.slips_ns.append(time.monotonic_ns())
                await self.say(self.slip())

    def _answer(self, message):
        replies = []
        name = {"insertion_id": message.insertion_id}
        self.insertion_id = message.insertion_id
        match message:
            case wire.ClientHello():
                self._attempt, self._watching = 0, False
                replies = [self.hello(clock=clock(message, time.monotonic_ns()))]
            case wire.ClientHeartbeat() if not self.silent_heartbeat:
                replies = [beat(message, time.monotonic_ns(), 10.0)]
            case wire.LearnOpen():
                replies = [wire.OpenLearnt(**name)]
            case wire.Arm():
                self._attempt, self._watching = message.attempt, True
                now_ns = time.monotonic_ns()
                replies = [wire.Armed(**name, attempt=message.attempt, reference_seq=1, frame_captured_ns=now_ns)]
            case wire.Stopped(outcome="blocked"):
                self._watching = False
                replies = [self.correction(message.attempt)]
            case wire.Stopped():
                self._watching = False
                replies = [wire.Finished(**name, outcome="inserted", attempts=message.attempt)]
            case wire.Abort():
                self._watching = False
                replies = [wire.Finished(**name, outcome="aborted", attempts=self._attempt)]
        return replies


@dataclass
class Bench:
    """The emulators, the service and the settings to reach them."""

    board: FaultBoard
    cabinet: Cabinet
    egm: EgmEmulator
    gripper: Gripper
    wsg: Wsg50Emulator
    service: TruthfulService
    settings: Settings
    rapid: RapidServers
    trace: list = field(default_factory=list)
    report: Report | None = None
    runner: Runner | None = None
    lines: list = field(default_factory=list)
    stood_s: float = 0.0

    async def notice_pauses(self):
        """Keep in ``stood_s`` the longest time for which this machine gave the cell no time to run."""
        while True:
            before_s = time.monotonic()
            await asyncio.sleep(0.01)
            self.stood_s = max(self.stood_s, time.monotonic() - before_s)

    async def insert(self, x_mm=8.0, theta_deg=6.0, log=None, observers=()):
        plan = make_plan(self.settings, x_mm, theta_deg, "test", None)
        arm, gripper, service = live_ports(self.settings, plan)
        self.report = Report(arm.position, self.lines.append)
        self.runner = Runner(plan, arm, gripper, service, Recorder(log, plan), (self.report, *observers))
        return await self.runner.run()


def undisturbed(story, tries_n=5):
    """What ``story()``, a coroutine, gives: a cell and more. Played afresh where the machine stood still in it.

    Cameras, service, arm and client are one process here. An insertion in which it stands still is rightly held.
    """
    for _ in range(tries_n):
        cell, *more = asyncio.run(asyncio.wait_for(story(), 60.0))
        if cell.stood_s < 0.5 * PAUSE_S:
            break
    return cell, *more


def side_by_side(stories, cells_n=6):
    """How each coroutine of a dictionary ends, ``cells_n`` cells at a time: most of their time is waiting.

    What went wrong in one is kept, and raised where :func:`outcome` is asked for it.
    """

    async def one(story, turn):
        async with turn:
            return await asyncio.wait_for(story, 60.0)

    async def every():
        turn = asyncio.Semaphore(cells_n)
        return await asyncio.gather(*(one(story, turn) for story in stories.values()), return_exceptions=True)

    return dict(zip(stories, asyncio.run(every()), strict=True))


def outcome(ends, name):
    if isinstance(ends[name], BaseException):
        raise ends[name]
    return ends[name]


@contextlib.asynccontextmanager
async def bench(*, lag_ms=20.0, holding=True, overrides=None, device="abb_egm", part=None, omnicore=None):
    """``omnicore``: files of a certificate and its key, for a controller of RobotWare 7."""
    board = FaultBoard()
    start = Pose((5.0, 0.0, 40.0), tool_down(0.0))
    delays = Delays(motors_s=0.02, program_start_s=0.02, program_stop_s=0.05, communication_timeout_s=1.0)
    cabinet = Cabinet(Follower(start, MotionLimits(lag_s=lag_ms / 1000.0)), board, delays)
    frames = CellFrames()
    guide_port = free_port(socket.SOCK_DGRAM)
    egm = EgmEmulator(cabinet, frames, guide_port)
    rws_socket, wsg_socket = bind_tcp(0, "RWS"), bind_tcp(0, "gripper")
    if omnicore:
        gate = Gate(board, Basic)
        rws = HttpServer(create_app2(cabinet, frames, gate), rws_socket, omnicore)
    else:
        gate = Gate(board)
        rws = HttpServer(create_app(cabinet, frames, gate), rws_socket)
    gate.abort = rws.abort
    gripper = Gripper(part or Part(), board, holding=holding)
    wsg = Wsg50Emulator(gripper, board)
    service = TruthfulService(cabinet)
    wsg_port = port_of(wsg_socket)
    rapid = RapidServers(cabinet, silence_s=2.0)
    await rapid.start(bind_tcp(0, "motion"), bind_tcp(0, "guard"))
    if device == "abb_rapid":
        egm.on_cycle.append(rapid.cycle)
    await egm.start(bind_udp(0, "EGM"))
    await wsg.start(wsg_socket)
    await rws.start()
    server = await serve(service.handle, "127.0.0.1", 0, compression=None)
    service_port = server.sockets[0].getsockname()[1]
    own = {
        "abb_egm": {"port": guide_port, "bind": "127.0.0.1", "ready_timeout_s": 20.0, "max_age_s": 2.0},
        "abb_rapid": {"host": "127.0.0.1", "motion_port": rapid.motion_port, "guard_port": rapid.guard_port},
    }
    scheme, trust = ("https", {"certificate": omnicore[0]}) if omnicore else ("http", {})
    rws_table = {"url": f"{scheme}://127.0.0.1:{rws.port}", "poll_s": 0.01, **dict.fromkeys(_RWS_TIMES, 20.0), **trust}
    sections = {
        "robot": {"device": device, **own[device], "rws": rws_table},
        "service": {"url": f"ws://127.0.0.1:{service_port}", "connect_timeout_s": 20.0},
        "gripper": {"host": "127.0.0.1", "port": wsg_port, "grasp_speed_mm_s": 150.0, "reply_timeout_s": 20.0},
        "task": {"expected_depth_mm": 12.0, "depth_tolerance_mm": 0.5},
    }
    keep_token(state_folder())
    settings = load_settings(None, _merged(sections, overrides or {}))
    cell = Bench(board, cabinet, egm, gripper, wsg, service, settings, rapid)
    egm.on_cycle.append(lambda: cell.trace.append((time.monotonic(), cabinet.arm.target, cabinet.arm.pose)))
    pauses = asyncio.create_task(cell.notice_pauses())
    try:
        yield cell
    finally:
        pauses.cancel()
        server.close()
        await rapid.close()
        await egm.stop()
        await wsg.stop()
        rws.stop()
