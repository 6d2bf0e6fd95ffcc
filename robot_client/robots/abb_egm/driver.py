"""The arm over EGM position guidance: it answers every datagram of the robot with the next target.

The robot sends first, 250 times per second; only the newest datagram is answered. Targets advance on the robot's own
clock, so a stalled link stalls the motion and never makes it leap. Every failure ends in a latched hold: the target
stays frozen, datagrams are still answered with it, and no move is accepted any more.
"""

import asyncio
import contextlib
import socket
import time
from dataclasses import dataclass, field
from typing import Any

from robot_client.insertion.events import Arrived, Failure, Standstill, Stood
from robot_client.insertion.geometry import CellFrame, Pose, WorkPose
from robot_client.insertion.lease import Unwatched
from robot_client.insertion.limits import Leg, LimitError, Limits, Motion
from robot_client.insertion.motion import SETTLE_S, MotionGuide, Ramps
from robot_client.ports import Arm, Check, DriverError, Finding, Post, Signals
from robot_client.robots.abb_egm import codec
from robot_client.robots.abb_egm.righting import Righting
from robot_client.robots.abb_egm.settings import Settings
from robot_client.robots.abb_egm.udp import address_of, listen
from robot_client.robots.abb_egm.watch import EgmWatch, StreamFault
from robot_client.robots.abb_rws.client import RwsClient
from robot_client.robots.abb_rws.generation import RwsError
from robot_client.silence import Silence


@dataclass(slots=True)
class EgmArm:
    """Arm port over EGM, with RWS to start and stop the program (None: started by hand, stopped by silence)."""

    settings: Settings
    limits: Limits
    ramps: Ramps
    frame: CellFrame = field(default_factory=CellFrame)
    rws: RwsClient | None = None
    _post: Post = field(init=False, repr=False)
    _socket: socket.socket | None = None
    _robot: tuple[str, int] | None = None
    _guide: MotionGuide | None = None
    _righting: Righting = field(init=False, repr=False)
    _watch: EgmWatch = field(init=False)
    _measured: WorkPose | None = None
    _sequence: int = 0
    _ahead: int = 0  # answers that went out before their datagram came
    _failed: str = ""
    _ready: asyncio.Event = field(default_factory=asyncio.Event)
    _timer: asyncio.TimerHandle | None = None
    _stopping: asyncio.Task[str] | None = None
    _foreign: int = 0
    _worst_reply_us: float = 0.0
    _holds_us: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        silence = Silence(self.settings.silence_s, self.settings.silence_s / 4.0)
        self._watch = EgmWatch(silence, self.settings.max_age_s)

    # ---- port -----------------------------------------------------------------------------------------------------

    async def start(self, post: Post) -> WorkPose:
        """Listen, start motors and program, wait for the first good datagram."""
        self._post = post
        self._socket = listen(self.settings)
        asyncio.get_running_loop().add_reader(self._socket, self._on_readable)
        try:
            if self.rws is not None:
                await self.rws.start_program()
            async with asyncio.timeout(self.settings.ready_timeout_s):
                await self._ready.wait()
        except RwsError as error:
            raise DriverError(f"robot: {self._watch.leans or error}") from None
        except TimeoutError:
            why = self._watch.not_ready or "no datagram came: check UCdevice address, port, firewalls, that EGM runs"
            if self._foreign and not self._watch.datagrams:
                why = f"{self._foreign} datagrams came, none from {self.settings.robot_host} (robot.robot_host)"
            where = f"UDP port {self._socket.getsockname()[1]} in {self.settings.ready_timeout_s:g} s"
            raise DriverError(f"robot: EGM not ready on {where}: {why}") from None
        if self._guide is None:
            raise DriverError(f"robot: {self._watch.leans}")
        self._watchdog()
        return self._guide.target

    def move(self, target: WorkPose, motion: Motion, until_s: float | None = None, legs: tuple[Leg, ...] = ()) -> None:
        """Begin a move; raises LimitError if it is not allowed, or the arm is latched or closed."""
        if self._failed or self._guide is None:
            raise LimitError(f"the arm takes no motion: {self._failed or 'not started'}")
        self._guide.move(target, motion, until_s, legs)

    def renew(self, until_s: float) -> None:
        """Let the descent under way go on until then: checked before each of the 250 targets per second."""
        if self._guide is not None:
            self._guide.renew(until_s)

    def hold(self, reason: str, *, stop: bool) -> None:
        """Freeze the target and send it now, without waiting for the robot's next datagram."""
        begun_ns = time.perf_counter_ns()
        if self._guide is not None:
            self._guide.hold()
            self._answer()
            self._ahead += 1
            self._holds_us.append((time.perf_counter_ns() - begun_ns) / 1e3)
        if stop:
            self._failed = self._failed or reason
            self._stop_program()

    async def close(self) -> str:
        """Stop the program while still answering with the frozen target, then stop listening."""
        self._failed = self._failed or "closed"
        if self._guide is not None:
            self._guide.hold()
        self._stop_program()
        outcome = await self._stopping if self._stopping else "no program was started"
        if self._timer is not None:
            self._timer.cancel()
        if self._socket is not None:
            asyncio.get_running_loop().remove_reader(self._socket)
            self._socket.close()
        if self.rws is not None:
            await self.rws.close()
        return outcome

    def position(self) -> WorkPose | None:
        """Pose measured by the newest datagram."""
        return self._measured

    def target(self) -> WorkPose | None:
        """Target of the last answer."""
        return None if self._guide is None else self._guide.target

    def statistics(self) -> dict[str, Any]:
        """Counts of the stream and the worst times in microseconds from datagram to answer and from hold to wire."""
        return {
            **self._watch.statistics(),
            "pauses": 0 if self._guide is None else self._guide.pauses_n,
            "foreign_datagrams": self._foreign,
            "worst_reply_us": round(self._worst_reply_us),
            "worst_hold_us": round(max(self._holds_us, default=0.0)),
        }

    def signals(self) -> Signals | None:
        return self.rws

    def checks(self) -> dict[str, Check]:
        """The controller's state, and our listening port."""
        robot = {} if self.rws is None else {"robot": self.rws.findings}
        return {**robot, "guidance": self._check_port}

    async def _check_port(self) -> list[Finding]:
        listen(self.settings).close()  # its refusal is the finding
        where = f"UDP {self.settings.bind}:{self.settings.port}"
        return [Finding(True, f"{where} is free; the controller's UCdevice must send to it")]

    # ---- wire -----------------------------------------------------------------------------------------------------

    def _on_readable(self) -> None:
        """Take the newest of the waiting datagrams and answer it."""
        received_ns = time.perf_counter_ns()
        newest: bytes | None = None
        assert self._socket is not None
        with contextlib.suppress(BlockingIOError, ConnectionError):
            for _ in range(64):  # an endless sender must not block the loop
                datagram, address = self._socket.recvfrom(codec.MAX_DATAGRAM_BYTES + 1)
                if self._is_robot(address):
                    newest = datagram
                    self._watch.datagrams += 1
        if newest is not None:
            try:
                self._on_datagram(newest, time.monotonic())
            except Exception as error:  # a defect of ours must not leave the arm moving on old orders
                self._fail("internal", f"{type(error).__name__}: {error}")
                raise
            self._worst_reply_us = max(self._worst_reply_us, (time.perf_counter_ns() - received_ns) / 1e3)

    def _is_robot(self, address: tuple[str, int]) -> bool:
        may_change = self._guide is None and self._watch.not_ready  # each run may have its own port
        if self.settings.robot_host not in (None, address[0]) or not (may_change or self._robot in (None, address)):
            self._foreign += 1
            return False
        self._robot = address
        return True

    def _on_datagram(self, datagram: bytes, now_s: float) -> None:
        try:
            state = codec.decode_robot(datagram)
            near_deg = self._guide.target.yaw_deg if self._guide else self.limits.middle_yaw_deg
            measured, tilt_deg = self.frame.from_controller(state.feedback, near_deg)
        except ValueError as error:
            self._watch.bad(str(error))
            return
        elapsed_s = self._watch.take(state, now_s)
        if elapsed_s is None:
            return
        if self._guide is None and not self._begin(state, measured, tilt_deg):
            return
        self._measured = measured
        self._check(state, measured, tilt_deg)
        self._advance(elapsed_s, now_s)
        self._answer_once()
        self._report(measured, now_s)

    def _begin(self, state: codec.RobotState, measured: WorkPose, tilt_deg: float) -> bool:
        """Begin guidance at the arm's present pose. Targets are upright: a tool that leans too far is not for them."""
        if not self._watch.ready(state):
            self._answer(state.feedback if state.waits and not self._watch.leans else None)
            return False
        if not self._watch.upright(tilt_deg, self.limits.max_tilt_deg):
            self._ready.set()
            return False
        self._guide = MotionGuide(self.limits, self.ramps, measured)
        self._righting = Righting.of(self.frame, state.feedback, measured)
        self._ready.set()
        return True

    def _check(self, state: codec.RobotState, measured: WorkPose, tilt_deg: float) -> None:
        assert self._guide is not None
        if self._failed or not self._timer:
            return
        away_mm = self._guide.target.distance_mm(measured)
        try:
            self._watch.check(state)
        except StreamFault as fault:
            self._fail(fault.code, fault.detail)
        if tilt_deg > self.limits.max_tilt_deg:
            self._fail("tilt", f"the tool is tilted by {tilt_deg:.2f} deg, allowed {self.limits.max_tilt_deg:g}")
        if away_mm > self.limits.max_tracking_mm:
            bound_mm = self.limits.max_tracking_mm
            self._fail("tracking", f"the arm is {away_mm:.2f} mm away from its target, allowed {bound_mm:g}")

    def _advance(self, elapsed_s: float, now_s: float) -> None:
        assert self._guide is not None
        before = self._guide.target
        try:
            if self._guide.advance(elapsed_s, now_s) != before:
                self._righting.go_on(elapsed_s)
        except Unwatched as error:
            self._fail("unwatched", str(error))
        except LimitError as error:
            self._fail("limits", str(error))

    def _answer_once(self) -> None:
        """Answer the datagram, unless a hold already has: the controller queues answers and takes one a cycle."""
        assert self._guide is not None
        if self._ahead and not self._guide.moving:
            self._ahead -= 1
        else:
            self._answer()

    def _answer(self, unguided: Pose | None = None) -> None:
        pose = unguided if self._guide is None else self._righting.pose(self._guide.target)
        if pose is None or self._robot is None or self._socket is None:
            return
        self._sequence += 1
        time_ms = time.monotonic_ns() // 1_000_000
        with contextlib.suppress(OSError):  # a full buffer or an unreachable host shows as silence of the stream
            self._socket.sendto(codec.encode_guidance(codec.Guidance(self._sequence, time_ms, pose)), self._robot)

    def _report(self, measured: WorkPose, now_s: float) -> None:
        assert self._guide is not None
        if lost_s := self._guide.take_lost_s():
            self._post(Stood(at_s=now_s, stood_s=lost_s))
        settled = self._guide.observe(measured, now_s)
        if settled and not self._failed:
            still = Standstill(at_s=now_s, pose=measured, still_s=SETTLE_S)
            self._post(Arrived(at_s=now_s, pose=measured) if settled == "arrived" else still)

    # ---- trouble --------------------------------------------------------------------------------------------------

    def _watchdog(self) -> None:
        loop = asyncio.get_running_loop()
        self._timer = loop.call_later(self.settings.silence_s / 4.0, self._watchdog)
        try:
            self._watch.check_silence(time.monotonic())
        except StreamFault as fault:
            self._fail(fault.code, fault.detail)

    def _fail(self, code: str, detail: str) -> None:
        """Freeze first, report afterwards; only once."""
        if self._failed:
            return
        self._failed = f"{code}: {detail}"
        assert self._guide is not None
        self._guide.hold()
        self._answer()
        self._post(Failure(at_s=time.monotonic(), source="arm", code=code, detail=detail))

    def _stop_program(self) -> None:
        if self.rws is not None and self.rws.started and self._stopping is None:
            self._stopping = asyncio.get_running_loop().create_task(self.rws.stop_program())


def make(settings: Settings, limits: Limits, ramps: Ramps, frame: CellFrame) -> Arm:
    """The arm with RWS; only the robot's host, by default the one in the RWS address, receives guidance."""
    if settings.robot_host is None:
        settings = settings.model_copy(update={"robot_host": address_of(settings.rws.host)})
    return EgmArm(settings, limits, ramps, frame, RwsClient(settings.rws))
