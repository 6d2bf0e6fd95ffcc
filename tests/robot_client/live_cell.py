"""A small live cell for the tests: the emulated robot and gripper, and a decision service that knows the truth.

Everything runs on the test's event loop over real sockets. Contact is geometry, as exact as the tests need it.
"""

import asyncio
import contextlib
import random
import time
from dataclasses import dataclass, field

from websockets.asyncio.server import serve

from robot_client.cli.insert import live_ports, make_plan
from robot_client.insertion.lease import PAUSE_S
from robot_client.ports import DriverError
from robot_client.session.recorder import Recorder
from robot_client.session.report import Report
from robot_client.session.runner import Runner
from robot_client.settings import Settings, _merged, load_settings
from service.contract.token import keep_token, state_folder
from simulation.cell.emulators.abb.cabinet import Cabinet, Delays
from simulation.cell.emulators.abb.egm import EgmEmulator
from simulation.cell.emulators.abb.frames import CellFrames
from simulation.cell.emulators.abb.motion import Follower, MotionLimits, Pose, tool_down
from simulation.cell.emulators.abb.rapid import RapidServers
from simulation.cell.emulators.abb.rws import Gate, create_app
from simulation.cell.emulators.faults import FaultBoard
from simulation.cell.emulators.net import BusyPortError, HttpServer, bind_tcp, bind_udp, port_of
from simulation.cell.emulators.wsg50 import Wsg50Emulator
from simulation.cell.emulators.wsg50_gripper import Gripper
from tests.robot_client.robots.abb_rws.omnicore import Basic, create_app2
from tests.robot_client.truthful_service import TruthfulService

# A busy machine may stop this process, emulators included, for long: who tests a time sets it.
_RWS_TIMES = ("request_timeout_s", "motors_timeout_s", "start_timeout_s", "stop_timeout_s")


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

    async def insert(self, x_mm=8.0, theta_deg=6.0, log=None, observers=()):
        plan = make_plan(self.settings, x_mm, theta_deg, "test", None)
        arm, gripper, service = live_ports(self.settings, plan)
        self.report = Report(arm.position, self.lines.append)
        self.runner = Runner(plan, arm, gripper, service, Recorder(log, plan), (self.report, *observers))
        return await self.runner.run()


async def _paused_s(kept):
    """Keep the longest time for which this machine gave the process no time to run."""
    while True:
        before_s = time.monotonic()
        await asyncio.sleep(0.01)
        kept[0] = max(kept[0], time.monotonic() - before_s)


def undisturbed(story, timeout_s=60.0, tries_n=5):
    """What a coroutine, made by ``story()``, gives; played afresh where it fails and the machine stood still in it.

    Cameras, service, arm and client are one process here. If it stands still in a descent, the arm is rightly held.
    """

    async def watched(kept):
        watch = asyncio.create_task(_paused_s(kept))
        try:
            return await asyncio.wait_for(story(), timeout_s)
        finally:
            watch.cancel()

    for _ in range(tries_n - 1):
        kept = [0.0]
        try:
            return asyncio.run(watched(kept))
        except (AssertionError, DriverError, asyncio.CancelledError):  # the last where it was held before an interrupt
            if kept[0] < 0.5 * PAUSE_S:
                raise
    return asyncio.run(watched([0.0]))


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


def unused_guide_port():
    """Below the ports that the kernel gives away: else another socket takes it before the driver listens on it."""
    while True:
        with contextlib.suppress(BusyPortError), bind_udp(random.SystemRandom().randrange(12_000, 32_000), "") as free:
            return port_of(free)


@contextlib.asynccontextmanager
async def bench(*, lag_ms=20.0, holding=True, overrides=None, device="abb_egm", part=None, omnicore=None):
    """``omnicore``: files of a certificate and its key, for a controller of RobotWare 7."""
    board = FaultBoard()
    start = Pose((5.0, 0.0, 40.0), tool_down(0.0))
    delays = Delays(motors_s=0.02, program_start_s=0.02, program_stop_s=0.05, communication_timeout_s=1.0)
    cabinet = Cabinet(Follower(start, MotionLimits(lag_s=lag_ms / 1000.0)), board, delays)
    cabinet.sockets = device == "abb_rapid"
    frames = CellFrames()
    guide_port = unused_guide_port()
    egm = EgmEmulator(cabinet, frames, guide_port)
    rws_socket, wsg_socket = bind_tcp(0, "RWS"), bind_tcp(0, "gripper")
    if omnicore:
        gate = Gate(board, Basic)
        rws = HttpServer(create_app2(cabinet, gate), rws_socket, omnicore)
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
    try:
        yield cell
    finally:
        server.close()
        await rapid.close()
        await egm.stop()
        await wsg.stop()
        rws.stop()
