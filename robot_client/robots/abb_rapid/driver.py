"""The arm on a controller without EGM: RAPID moves along straight lines, a guard task stops it.

Two connections: motion (one request, one answer when it is over) and guard (position, release, stop, dead-man switch).
A hold goes to the guard at once and does not wait for the motion server, which is busy moving. If this process falls
silent, the guard stops the arm by itself. Stopping is slower than with EGM; its time depends on the controller.
"""

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

from robot_client.insertion.events import Arrived, Failure, Standstill
from robot_client.insertion.geometry import CellFrame, WorkPose
from robot_client.insertion.lease import check_leased
from robot_client.insertion.limits import Leg, LimitError, Limits, Motion, check_arrived, check_pose
from robot_client.insertion.motion import Ramps
from robot_client.ports import Arm, Check, DriverError, Finding, Post, Signals
from robot_client.robots.abb_rapid import codec
from robot_client.robots.abb_rapid.codec import GuardState, MotionAnswer, TextParser
from robot_client.robots.abb_rapid.settings import Settings
from robot_client.robots.abb_rws.client import RwsClient
from robot_client.robots.abb_rws.generation import RwsError
from robot_client.silence import Silence

_LEASE_CHECK_S = 0.005
_STILL_MM, _STILL_DEG, _STILL_S = 0.03, 0.05, 0.15  # the guard answers with 0.01 mm
_STUCK_S = 1.0  # in a move: its program was stopped, which closes no socket


@dataclass(slots=True)
class SocketArm:
    """Arm port over the two RAPID sockets, with RWS to start and stop the program."""

    settings: Settings
    limits: Limits
    ramps: Ramps
    frame: CellFrame = field(default_factory=CellFrame)
    rws: RwsClient | None = None
    _post: Post | None = None
    _motion: asyncio.StreamWriter | None = None
    _guard: asyncio.StreamWriter | None = None
    _tasks: list[asyncio.Task[None]] = field(default_factory=list)
    _stopping: asyncio.Task[str] | None = None
    _number: int = 0
    _move: int = 0
    _pending: tuple[int, WorkPose, float] | None = None
    _sent: int | None = None  # a move not yet answered by the motion server
    _waiting: Literal["arrived", "fresh position", "rest", "standstill"] | None = None
    _asked: int = 0
    _here: WorkPose | None = None
    _target: WorkPose | None = None
    _still: tuple[WorkPose, float] | None = None  # the arm stands here since then
    _silence: Silence = field(init=False)
    _latched: str = ""
    _answers: int = 0
    _until_s: float | None = None

    def __post_init__(self) -> None:
        self._silence = Silence(self.settings.silence_s, self.settings.poll_s)

    # ---- port -----------------------------------------------------------------------------------------------------

    async def start(self, post: Post) -> WorkPose:
        """Start the program, connect to both ports, wait for the first position; raises DriverError."""
        if self.rws is not None:
            try:
                await self.rws.start_program()
            except RwsError as error:
                raise DriverError(f"robot: {error}") from None
        motion_reader, self._motion = await self._connect(self.settings.motion_port, "motion server")
        guard_reader, self._guard = await self._connect(self.settings.guard_port, "guard")
        self._silence.heard(time.monotonic())
        motion = self._read(motion_reader, self._on_motion, "motion server")
        for work in (motion, self._read(guard_reader, self._on_guard, "guard"), self._beat(), self._lapse()):
            self._tasks.append(asyncio.get_running_loop().create_task(work))
        deadline_s = time.monotonic() + self.settings.connect_timeout_s
        while self._here is None or self._latched:
            if self._latched:
                raise DriverError(f"robot: {self._latched}")
            if time.monotonic() > deadline_s:
                raise DriverError("robot: the guard does not report where the arm is; is TactileGuard.mod running?")
            await asyncio.sleep(0.01)
        self._post = post
        return self._here

    def move(self, target: WorkPose, motion: Motion, until_s: float | None = None, legs: tuple[Leg, ...] = ()) -> None:
        """Lower the guard's stop flag, then send the move; raises LimitError if it is not allowed."""
        check_leased(motion, until_s)
        check_pose(self.limits, target, here=self._here)
        if legs:
            raise LimitError("pace.fast_mm_s: over RAPID sockets a descent has one speed; leave it out, or use EGM")
        if self._latched or self._guard is None or self._here is None:
            raise LimitError(f"the arm takes no motion: {self._latched or 'not started'}")
        speed = self.ramps.of(motion).speed_mm_s
        top = self.limits.max_descent_speed_mm_s if motion == "descend" else self.limits.max_speed_mm_s
        if not speed <= top:
            raise LimitError(f"{motion} speed mm/s = {speed:g}, allowed up to {top:g}")
        self._until_s = until_s
        self._move = self._next()
        self._pending, self._waiting, self._still = (self._move, target, speed), "arrived", None
        self._target = target
        self._ask_guard("R", self._move)

    def renew(self, until_s: float) -> None:
        """Let the descent under way go on until then."""
        self._until_s = until_s

    def hold(self, reason: str, *, stop: bool) -> None:
        """Raise the guard's stop flag now; a move that still waits for its release is dropped."""
        self._until_s = None
        self._pending, self._waiting, self._still = None, "standstill", None
        self._ask_guard("S", self._next())
        if stop:
            self._latched = self._latched or reason
            self._stop_program()

    async def close(self) -> str:
        self._post, self._until_s, self._latched = None, None, self._latched or "closed"
        self._ask_guard("S", self._next())
        self._stop_program()
        outcome = await self._stopping if self._stopping else "guard stopped the arm; no program was started"
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        for writer in filter(None, (self._motion, self._guard)):
            writer.close()
        if self.rws is not None:
            await self.rws.close()
        return outcome

    def position(self) -> WorkPose | None:
        return self._here

    def target(self) -> WorkPose | None:
        """End of the latest move: only the controller knows its targets on the way."""
        return self._target

    def statistics(self) -> dict[str, Any]:
        return {"guard_answers": self._answers}

    def signals(self) -> Signals | None:
        return self.rws

    def checks(self) -> dict[str, Check]:
        """The controller's state; the sockets are only named, since connecting to them starts the program."""
        robot = {} if self.rws is None else {"robot": self.rws.findings}
        return {**robot, "guidance": self._check_sockets}

    async def _check_sockets(self) -> list[Finding]:
        where = f"{self.settings.host}:{self.settings.motion_port} and :{self.settings.guard_port}"
        return [Finding(True, f"RAPID sockets at {where}, not opened: opening them is the program's start")]

    # ---- wire -----------------------------------------------------------------------------------------------------

    async def _connect(self, port: int, name: str) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        """A RAPID server may need a moment after the start before it listens."""
        deadline_s = time.monotonic() + self.settings.connect_timeout_s
        while True:
            try:
                async with asyncio.timeout(self.settings.connect_timeout_s):
                    return await asyncio.open_connection(self.settings.host, port)
            except (OSError, TimeoutError) as error:
                if time.monotonic() > deadline_s:
                    where = f"{self.settings.host}:{port}"
                    raise DriverError(f"robot: cannot connect to the {name} at {where}: {error}") from None
            await asyncio.sleep(0.1)

    def _next(self) -> int:
        self._number = self._number % codec.MAX_NUMBER + 1
        return self._number

    def _ask_guard(self, kind: Literal["H", "R", "S"], number: int) -> None:
        if self._guard is not None and not self._guard.is_closing():
            self._guard.write(codec.encode_guard(kind, number))

    async def _beat(self) -> None:
        """Ask for the arm's position: requests keep the guard's dead-man switch alive, answers our watchdog."""
        while True:
            await asyncio.sleep(self.settings.poll_s)
            self._ask_guard("H", self._next())
            silent_s = self._silence.over(time.monotonic())
            if silent_s is not None:
                self._fail("silent", f"the guard has not answered for {silent_s * 1e3:.0f} ms")

    async def _lapse(self) -> None:
        """Raise the stop flag when the lease of a descent ends."""
        while True:
            await asyncio.sleep(_LEASE_CHECK_S)
            if self._until_s is not None and time.monotonic() >= self._until_s:
                self._fail("unwatched", "no frame was judged in time: the lease ended")

    async def _read(self, reader: asyncio.StreamReader, on_text: Callable[[str], None], name: str) -> None:
        parser = TextParser()
        try:
            while data := await reader.read(4096):
                for text in parser.feed(data):
                    on_text(text)
        except OSError:
            pass  # closed, too
        except Exception as error:  # a defect of ours must not leave the arm moving unheard
            self._fail("internal", f"{type(error).__name__}: {error}")
            raise
        self._fail("link", f"the {name} closed the connection")

    def _on_guard(self, text: str) -> None:
        try:
            state = codec.decode_guard(text)
            near_deg = self._here.yaw_deg if self._here else self.limits.middle_yaw_deg
            self._here, tilt_deg = self.frame.from_controller(state.pose, near_deg)
        except ValueError as error:
            if self._here is None:  # as of modules of another release
                self._fail("protocol", str(error))
            return  # not an answer: only answers keep the link alive
        self._silence.heard(time.monotonic())
        self._answers += 1
        if tilt_deg > self.limits.max_tilt_deg:
            self._fail("tilt", f"the tool is tilted by {tilt_deg:.2f} deg")
        self._release(state)
        self._settle(self._here, state)

    def _release(self, state: GuardState) -> None:
        """Start the move: the guard has confirmed that its flag is down for it."""
        if self._pending is None or state.number != self._pending[0] or state.stopped:
            return
        number, target, speed = self._pending
        self._pending = None
        if self._motion is not None and not self._latched:
            self._sent = number
            self._motion.write(codec.encode_move(number, self.frame.to_controller(target), speed))

    def _on_motion(self, text: str) -> None:
        try:
            answer: MotionAnswer = codec.decode_motion(text)
        except ValueError as error:
            self._fail("protocol", str(error))
            return
        if answer.number == self._sent:
            self._sent = None
        if answer.result == "refused":
            self._fail("refused", f"the motion server refused: {answer.reason}")
        elif answer.number == self._move and self._waiting == "arrived":
            if answer.result == "stopped":
                self._fail("guard", "the guard stopped the arm without being asked")
            else:  # the position after the move comes with the next answer
                self._waiting, self._asked = "fresh position", self._next()
                self._ask_guard("H", self._asked)

    def _settle(self, here: WorkPose, state: GuardState) -> None:
        if self._waiting == "fresh position" and state.number == self._asked:
            self._waiting, self._still = "rest", None  # what the guard reads comes to rest only after the arm
        # A hold waits for the answer to a move that is still on its way: the next release would start it.
        held = self._waiting == "standstill" and state.stopped and self._sent is None
        now_s = time.monotonic()
        if self._waiting == "arrived" and self._sent and self._rests(here, now_s, _STUCK_S):
            self._fail("stuck", f"stands in its move for {_STUCK_S:g} s; was the program stopped? Look at the pendant")
        if not (held or self._waiting == "rest") or not self._rests(here, now_s):
            return
        self._waiting = None
        if not held:
            self._check_arrived(here)
        self._report(Standstill(at_s=now_s, pose=here, still_s=_STILL_S) if held else Arrived(at_s=now_s, pose=here))

    def _rests(self, here: WorkPose, now_s: float, for_s: float = _STILL_S) -> bool:
        """Whether the arm has stood here for long enough."""
        where, since_s = self._still or (here, now_s)
        if self._still is None or where.distance_mm(here) > _STILL_MM or where.turn_deg(here) > _STILL_DEG:
            self._still = here, now_s
            return False
        return now_s - since_s >= for_s

    def _check_arrived(self, here: WorkPose) -> None:
        assert self._target is not None
        try:
            check_arrived(self._target, here)
        except LimitError as error:
            self._fail("tracking", str(error))

    def _report(self, event: Arrived | Standstill) -> None:
        if self._post is not None and not self._latched:
            self._post(event)

    def _fail(self, code: str, detail: str) -> None:
        if self._latched:
            return
        self._latched = f"{code}: {detail}"
        self._pending = self._until_s = None
        self._ask_guard("S", self._next())
        if self._post is not None:
            self._post(Failure(at_s=time.monotonic(), source="arm", code=code, detail=detail))

    def _stop_program(self) -> None:
        if self.rws is not None and self.rws.started and self._stopping is None:
            self._stopping = asyncio.get_running_loop().create_task(self.rws.stop_program())


def make(settings: Settings, limits: Limits, ramps: Ramps, frame: CellFrame) -> Arm:
    """The arm with RWS, whose RAPID task restarts itself after a lost connection."""
    return SocketArm(settings, limits, ramps, frame, RwsClient(settings.rws, full_speed=True, cycle="forever"))
