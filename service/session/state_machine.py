"""One insertion, synchronous and free of I/O: messages and frames in, messages out.

The same object runs in real time (the service's perception thread calls it, the networks run in another thread) and
in lock step (the simulator calls it, the networks run inside :meth:`InsertionSession.on_pair`). Time is what the
caller says it is: every ``now_ns`` is on the clock of the frames' ``captured_ns``.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from service.contract import FINGERS, Finger, FramePair, TactileFrame, wire
from service.contract.wire import CameraEntry, ControllerName, Limits, ServiceMessage
from service.decision.attempt import Attempt, Stage, WorkResult
from service.decision.controllers import Command, make_controller
from service.decision.decider import Decider, Decision
from service.decision.models import ModelSet
from service.decision.work import Work, plan_work, slip_message
from service.perception.observation import FingerWatch, Observation, PairObservation, belongs
from service.settings import Deadlines

Replies = list[ServiceMessage]
DEFAULT_LIMITS = Limits(max_dx_mm=15.0, max_dtheta_deg=15.0, max_frame_age_ms=500.0)


def ignore(_: Any) -> None:
    """The observer of a session that has none."""


@dataclass(slots=True)
class InsertionSession:
    """State machine of one insertion (see :mod:`service.contract.wire` for the order of messages).

    ``submit`` takes network work to another thread, whose result comes back through :meth:`on_result`; without it the
    work runs at once. ``on_observation`` sees each observation, ``on_attempt`` each attempt when it is decided or
    ends, both for recording and display. With ``checks_full_depth`` full depth counts only where the gels agree.
    Not thread safe.
    """

    models: ModelSet
    left: FingerWatch
    right: FingerWatch
    controller_name: ControllerName = "belief"
    limits: Limits = DEFAULT_LIMITS
    deadlines: Deadlines = field(default_factory=Deadlines)
    cameras: Callable[[], tuple[CameraEntry, ...]] = tuple
    submit: Callable[[Work], None] | None = None
    on_observation: Callable[[Observation], None] = ignore
    on_attempt: Callable[[Attempt], None] = ignore
    on_command: Callable[[Command], None] = ignore
    checks_full_depth: bool = True
    insertion_id: str | None = None
    attempt: Attempt | None = None
    finished: wire.Finished | None = None
    recording: str | None = None
    _decider: Decider | None = None
    _observations: dict[Finger, Observation] = field(default_factory=dict)
    _newest_ns: dict[Finger, int] = field(default_factory=dict)
    _generation: int = 0

    # ---- messages -------------------------------------------------------------------------------------------------

    def handle(self, message: Any, now_ns: int) -> Replies:
        """Answer one client message; anything out of order is a non-fatal fault and changes nothing."""
        if self.insertion_id is not None and message.insertion_id != self.insertion_id:
            return [self._fault("protocol", f"insertion id {message.insertion_id}, expected {self.insertion_id}")]
        replies: Replies = []
        match message:
            case wire.ClientHello():
                replies = self._hello(message, now_ns)
            case _ if self.insertion_id is None:
                replies = [self._fault("protocol", f"{message.type} before hello", message.insertion_id)]
            case wire.ClientHeartbeat():
                replies = [wire.beat(message, now_ns, self._age_ms(now_ns))]
            case _ if self.finished is not None:
                replies = [self.finished]
            case wire.Arm():
                replies = self._arm(message, now_ns)
            case wire.Descending():
                replies = self._descending(message, now_ns)
            case wire.Stopped():
                replies = self._stopped(message, now_ns)
            case wire.Abort():
                replies = self._finish("aborted" if message.cause == "operator" else "failed", message.cause)
        return replies

    def _hello(self, message: wire.ClientHello, now_ns: int) -> Replies:
        if refused := wire.unspoken(message):
            return [refused]
        if self.insertion_id is None:
            self.insertion_id = message.insertion_id
            self.controller_name = message.controller or self.controller_name
        return [
            wire.ServiceHello(
                insertion_id=self.insertion_id,
                clock=wire.clock(message, now_ns),
                models=self.models.entries,
                cameras=self.cameras(),
                controller=self.controller_name,
                limits=self.limits,
            )
        ]

    def _arm(self, message: wire.Arm, now_ns: int) -> Replies:
        last = self.attempt.arm.attempt if self.attempt else 0
        decided = self.attempt is None or self.attempt.stage is Stage.DECIDED
        if self.attempt and message.attempt == last and not decided:
            if self.attempt.armed and self.attempt.stage is Stage.ARMED and not self.attempt.spoilt:
                return [self.attempt.armed]
        elif message.attempt != last + 1 or not decided:
            state = "decided" if decided else "not decided yet"
            return [self._fault("protocol", f"arm of attempt {message.attempt}, but attempt {last} is {state}")]
        if self._decider is None:
            controller = make_controller(self.controller_name, self.limits, message.grasp_height_mm)
            self._decider = Decider(message.insertion_id, self.models, controller, self.deadlines)
        self._generation += 1
        self.attempt = Attempt(message, now_ns, self._generation)
        return []

    def _descending(self, message: wire.Descending, now_ns: int) -> Replies:
        if self.attempt and self._is_current(message.attempt, {Stage.ARMED}):
            self.attempt.descending_ns = now_ns
            return []
        return [self._fault("protocol", f"descending in attempt {message.attempt}, which is not armed; send arm first")]

    def _stopped(self, message: wire.Stopped, now_ns: int) -> Replies:
        attempt = self.attempt
        if attempt and message.attempt == attempt.arm.attempt and attempt.decision:
            return [attempt.decision]
        if attempt is None or not self._is_current(message.attempt, {Stage.ARMED, Stage.STOPPED}):
            return [self._fault("protocol", f"stopped in attempt {message.attempt}, which is not armed")]
        attempt.outcome, attempt.depth_mm = message.outcome, message.depth_mm
        if message.outcome == "dropped":
            return self._end(attempt, "failed", "part_lost")
        if attempt.stage is Stage.ARMED:
            attempt.stage, attempt.stopped_ns = Stage.STOPPED, now_ns
        return self._conclude(now_ns)

    def _is_current(self, number: int, stages: set[Stage]) -> bool:
        return self.attempt is not None and number == self.attempt.arm.attempt and self.attempt.stage in stages

    # ---- frames ---------------------------------------------------------------------------------------------------

    @property
    def wants_frames(self) -> bool:
        """Whether an attempt is under way; frames between attempts, while the arm moves freely, are of no use."""
        return self.attempt is not None and self.attempt.stage is not Stage.DECIDED and self.finished is None

    @property
    def watches_slip(self) -> bool:
        """Whether the arm may be moving, so that a late slip message would mean a collision."""
        attempt = self.attempt
        return attempt is not None and attempt.stage is Stage.ARMED and not attempt.slip_sent

    def prime(self, frame: TactileFrame) -> None:
        """Let a finger's tracker find its grid before time matters: the search takes some 0.2 s, tracking 2 ms."""
        watch = self.left if frame.finger == "left" else self.right
        watch.observe(frame)

    def on_frame(self, frame: TactileFrame, now_ns: int) -> Replies:
        """Perceive one finger's frame; report slip at once, and else that both fingers are watched."""
        self._newest_ns[frame.finger] = frame.captured_ns
        attempt = self.attempt
        if attempt is None or not self.wants_frames:
            return []
        watch = self.left if frame.finger == "left" else self.right
        attempt.rearm(watch, frame)
        observation = watch.observe(frame)
        self._observations[frame.finger] = observation
        self.on_observation(observation)
        if attempt.stage is not Stage.ARMED or attempt.slip_sent:
            return []
        if not observation.slip.stop:
            return [*attempt.judged(observation, now_ns)]
        attempt.slip_sent = True
        return [slip_message(str(self.insertion_id), attempt, observation, now_ns)]

    def on_pair(self, pair: FramePair, now_ns: int) -> Replies:
        """Process both fingers' frames of one instant: slip, reference, onset, and the frames of the decision."""
        attempt = self.attempt
        if attempt is None or not self.wants_frames:
            self._newest_ns = {"left": pair.left.captured_ns, "right": pair.right.captured_ns}
            return []
        replies: Replies = []
        for frame in (pair.left, pair.right):
            observed = self._observations.get(frame.finger)
            if observed is None or not belongs(observed, pair):
                replies += self.on_frame(frame, now_ns)
        both = PairObservation(self._observations["left"], self._observations["right"])
        if attempt.stage is Stage.ARMING:
            armed = attempt.take_reference(both)
            return [*replies, armed] if armed else replies
        attempt.take_in(both)
        if attempt.outcome == "inserted":
            return replies + self._conclude(now_ns)
        return replies + self._feed(attempt, now_ns)

    def _feed(self, attempt: Attempt, now_ns: int) -> Replies:
        card = self.models.card
        replies: Replies = []
        for pair in attempt.take_decision_pairs(card.frames_per_decision, card.reference_rule):
            replies += self._submit(plan_work(self.models, attempt, pair), now_ns)
        return replies

    # ---- networks ------------------------------------------------------------------------------------------------

    def _submit(self, work: Work, now_ns: int) -> Replies:
        if self.submit is not None:
            self.submit(work)
            return []
        return self.on_result(result, now_ns) if (result := work.run()) else []

    def on_result(self, result: WorkResult, now_ns: int) -> Replies:
        """Take a result of the networks; results of another attempt or an earlier arming are dropped."""
        attempt = self.attempt
        if attempt is None or result.generation != attempt.generation or self.finished is not None:
            return []
        attempt.result = attempt.result or result
        return self._conclude(now_ns)

    def on_camera_fault(self, code: str, detail: str) -> Replies:
        """A camera failed: the client must hold, and an attempt under way needs a new reference."""
        attempt = self.attempt
        if attempt is None or not self.wants_frames:
            return []
        if attempt.stage is Stage.ARMED:
            attempt.broken = detail
        return [self._fault(code, detail)]

    # ---- decisions ------------------------------------------------------------------------------------------------

    def on_tick(self, now_ns: int) -> Replies:
        """Check deadlines and the age of the newest frame; call it a few times a second."""
        attempt = self.attempt
        if attempt is None or self.finished is not None:
            return []
        if attempt.stage is Stage.ARMING and now_ns - attempt.armed_ns > self.deadlines.reference_s * 1e9:
            self.attempt = None if attempt.arm.attempt == 1 else attempt
            attempt.stage = Stage.DECIDED
            return [attempt.refusal("no_reference", attempt.problem or "no frame pair arrived")]
        if attempt.stage is Stage.STOPPED:
            return self._conclude(now_ns)
        return self._check_age(attempt, now_ns)

    def _age_ms(self, now_ns: int) -> float | None:
        """Age of the newest frame of the finger that is further behind; neither finger detects slip for the other."""
        return (now_ns - min(self._newest_ns.values())) / 1e6 if len(self._newest_ns) == len(FINGERS) else None

    def _check_age(self, attempt: Attempt, now_ns: int) -> Replies:
        if attempt.stage is not Stage.ARMED or attempt.stale_sent or (age_ms := self._age_ms(now_ns)) is None:
            return []
        if age_ms <= self.limits.max_frame_age_ms:
            return []
        attempt.stale_sent = True
        return [self._fault("stale_frames", f"a finger's newest frame is {age_ms:.0f} ms old; hold until it is back")]

    def _conclude(self, now_ns: int) -> Replies:
        if self.attempt is None or self._decider is None:
            return []
        if self.attempt.outcome == "inserted":
            return self._conclude_full_depth(self.attempt, self._decider, now_ns)
        decision = self._decider.conclude(self.attempt, now_ns)
        if self._decider.command:
            self.on_command(self._decider.command)
        return [] if decision is None else self._decided(self.attempt, decision)

    def _conclude_full_depth(self, attempt: Attempt, decider: Decider, now_ns: int) -> Replies:
        if not self.checks_full_depth:
            return self._end(attempt, "inserted")
        against = decider.full_depth_objections(attempt, now_ns, self.limits.max_frame_age_ms)
        if against:
            return [*against, *self._end(attempt, "failed", "not_confirmed")]
        return [] if against is None else self._end(attempt, "inserted")

    def _decided(self, attempt: Attempt, decision: Decision) -> Replies:
        attempt.stage, attempt.decision = Stage.DECIDED, decision
        self.on_attempt(attempt)
        if attempt.arm.attempt >= wire.MAX_ATTEMPTS:
            return [decision, *self._finish("failed", "attempts")]
        return [decision]

    def _end(self, attempt: Attempt, outcome: Any, cause: wire.Cause | None = None) -> Replies:
        attempt.stage = Stage.DECIDED
        self.on_attempt(attempt)
        return self._finish(outcome, cause)

    def _finish(self, outcome: Any, cause: wire.Cause | None = None) -> Replies:
        self.finished = wire.Finished(
            insertion_id=str(self.insertion_id),
            outcome=outcome,
            attempts=self.attempt.arm.attempt if self.attempt else 0,
            cause=cause,
            recording=self.recording,
        )
        return [self.finished]

    def _fault(self, code: str, detail: str, insertion_id: str | None = None) -> wire.Fault:
        named = insertion_id or self.insertion_id or "none"
        return wire.Fault(insertion_id=named, code=code, detail=detail, fatal=False)
