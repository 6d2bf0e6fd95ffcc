"""The controller cabinet behind EGM and RWS: motors, mode, the RAPID program that runs EGM, signals, event log.

The emulated RAPID program is a guidance server: after the start it sets EGM up and runs it with EGM_STOP_HOLD and a
communication timeout. A guide that falls silent ends the run, the arm brakes and holds, and the program stops until it
is started again. Everything happens on the cell's event loop; ``advance`` is the only place where time passes.
"""

from collections import deque
from dataclasses import dataclass, field
from datetime import datetime
from typing import Literal

from simulation.cell.emulators.abb.motion import Follower, Pose
from simulation.cell.emulators.faults import FaultBoard

ControllerState = Literal["init", "motoroff", "motoron", "guardstop", "emergencystop", "emergencystopreset"]
EgmPhase = Literal["off", "waiting", "guided"]


class RefusedError(ValueError):
    """The controller refuses an action in its present state; ``code`` is RWS's own."""

    def __init__(self, message: str, code: int = -1073442801) -> None:
        super().__init__(message)
        self.code = code


@dataclass(frozen=True, slots=True)
class Delays:
    """How long the cabinet takes to carry out a request."""

    motors_s: float = 0.20
    program_start_s: float = 0.10
    program_stop_s: float = 0.12
    communication_timeout_s: float = 0.25  # silenceLimit of TactileEgm.mod


@dataclass(frozen=True, slots=True)
class LogEntry:
    """One line of the controller's event log; ``kind`` 1 information, 2 warning, 3 error."""

    number: int
    kind: int
    code: int
    title: str
    stamp: str


@dataclass(slots=True)
class Cabinet:
    """State of the emulated IRC5."""

    arm: Follower
    board: FaultBoard
    delays: Delays = field(default_factory=Delays)
    state: ControllerState = "motoroff"
    running: bool = False
    egm: EgmPhase = "off"
    speed_ratio: int = 100
    cycle: str = "forever"
    at_main: bool = True  # the program pointer
    sockets: bool = True  # the modules for sockets may be what runs, and no guide answers them
    signals: dict[str, float] = field(
        default_factory=lambda: {"doSlipStop": 0.0, "diObjectFixed": 1.0, "aoClampForce": 0.0}
    )
    ranges: dict[str, tuple[float, float]] = field(default_factory=lambda: {"aoClampForce": (0.0, 20.0)})
    """Names of the analog signals; all others are digital."""
    symbols: dict[str, str] = field(default_factory=dict)
    log: deque[LogEntry] = field(default_factory=lambda: deque(maxlen=1000))
    _motors_due_s: float | None = None
    _start_due_s: float | None = None
    _stop_due_s: float | None = None
    _last_guide_s: float = 0.0
    _now_s: float = 0.0
    _entries: int = 0

    @property
    def motors_on(self) -> bool:
        return self.state == "motoron"

    def note(self, kind: int, code: int, title: str) -> None:
        self._entries += 1
        stamp = datetime.now().strftime("%Y-%m-%d T  %H:%M:%S")  # noqa: DTZ005 the controller's own wall clock
        self.log.append(LogEntry(self._entries, kind, code, title, stamp))

    # ---- requests over RWS ------------------------------------------------------------------------------------

    def request_motors(self, on: bool) -> None:
        """Switch the drives; raise RefusedError while a safety stop is active."""
        if on and self.state not in ("motoroff", "motoron", "emergencystopreset"):
            raise RefusedError(f"motors cannot be switched on in state {self.state}")
        if on and self.board.faults.robot.motors_off:
            raise RefusedError("motors cannot be switched on: the drive contactor stays open")
        if on and self.board.faults.robot.mode != "AUTO":
            raise RefusedError("motors are switched on by the enabling device in manual mode")
        if on:
            self._motors_due_s = self._now_s + self.delays.motors_s
        else:
            self._drop_motors("motoroff", "motors off by request")

    def request_start(self) -> None:
        """Start the RAPID program; raise RefusedError if motors are off or the mode is manual."""
        if not self.motors_on:
            raise RefusedError(f"RAPID cannot start in state {self.state}; switch the motors on")
        if self.board.faults.robot.mode != "AUTO":
            raise RefusedError("RAPID cannot be started remotely in manual mode")
        if not self.running:
            self._start_due_s = self._now_s + self.delays.program_start_s

    def request_main(self) -> None:
        """Move the program pointer to main; raise RefusedError while RAPID runs."""
        if self.running:
            raise RefusedError("the program pointer cannot be moved while RAPID runs")
        self.at_main = True

    def request_stop(self) -> None:
        """Stop the RAPID program: the arm brakes at once; the state reads running until the arm is at rest."""
        self._start_due_s = None
        if self.board.faults.rws.stop_ignored or not self.running:
            return
        self.arm.braking = True
        self._stop_due_s = self._now_s + self.delays.program_stop_s

    def set_signal(self, name: str, value: str) -> None:
        """Set a signal; raises KeyError for an unknown one, ValueError for a value that it cannot take."""
        if name not in self.signals:
            raise KeyError(name)
        if name not in self.ranges and value not in ("0", "1"):
            raise ValueError(f"lvalue {value!r} of the digital signal {name}, expected 0 or 1")
        low, high = self.ranges.get(name, (0.0, 1.0))
        if not low <= float(value) <= high:
            raise ValueError(f"lvalue {value} of {name}, expected {low:g} to {high:g}")
        self.signals[name] = float(value)

    # ---- reports over EGM -------------------------------------------------------------------------------------

    def guide(self, target: Pose) -> None:
        """A valid message of the guide arrived: follow its target if EGM runs."""
        self._last_guide_s = self._now_s
        if self.egm == "waiting":
            self.egm = "guided"
        if self.egm == "guided" and self._stop_due_s is None:
            self.arm.target = target
            self.arm.braking = False

    def keep_alive(self) -> None:
        """A message of the guide without a target keeps the session alive; the arm holds its last target."""
        self._last_guide_s = self._now_s

    def guidance_error(self, reason: str) -> None:
        """The guide sent a target that no controller follows: end the run and hold."""
        self.note(3, 41822, f"EGM: {reason}")
        self._end_program()

    # ---- time -------------------------------------------------------------------------------------------------

    def advance(self, now_s: float) -> None:
        """Advance the controller's clock: safety faults, delayed actions, communication timeout, motion."""
        self._apply_faults()
        if self._motors_due_s is not None and now_s >= self._motors_due_s:
            self._motors_due_s = None
            self.state = "motoron"
            self.note(1, 10011, "Motors ON state")
        if self._start_due_s is not None and now_s >= self._start_due_s:
            self._start_due_s = None
            self._begin_program(now_s)
        self.arm.speed_share = self.speed_ratio / 100.0
        self.arm.advance(now_s - self._now_s)
        if self._stop_due_s is not None and now_s >= self._stop_due_s and self.arm.at_rest:
            self._end_program()
        unanswered = self.egm == "waiting" and not self.sockets
        if (self.egm == "guided" or unanswered) and now_s - self._last_guide_s > self.delays.communication_timeout_s:
            self.note(3, 41800, "EGM: communication with the guide timed out")
            self._end_program()
        self._now_s = now_s

    def _apply_faults(self) -> None:
        robot = self.board.faults.robot
        if robot.emergency_stop:
            self._drop_motors("emergencystop", "Emergency stop")
        elif robot.protective_stop:
            self._drop_motors("guardstop", "Protective stop")
        elif robot.motors_off and self.motors_on:
            self._drop_motors("motoroff", "Motors OFF: drive contactor opened")
        elif robot.mode != "AUTO" and self.running:
            self._drop_motors("motoroff", "Operating mode changed")
        elif self.state == "emergencystop":
            self.state = "emergencystopreset"
        elif self.state == "guardstop":
            self.state = "motoroff"

    def _drop_motors(self, state: ControllerState, title: str) -> None:
        if self.state == state:
            return
        self.state = state
        self._motors_due_s = None
        self.note(3 if state != "motoroff" else 1, 10012, title)
        self._end_program()

    def _begin_program(self, now_s: float) -> None:
        if not self.motors_on:
            return
        self.running, self.egm = True, "waiting"
        self.arm.hold()
        self.arm.braking = True
        self._last_guide_s = now_s
        self.note(1, *((10150, "Program started") if self.at_main else (10155, "Program restarted")))
        self.at_main = False

    def _end_program(self) -> None:
        self.arm.braking = True
        self._start_due_s = self._stop_due_s = None
        if self.running:
            self.note(1, 10151, "Program stopped")
        self.running, self.egm = False, "off"
