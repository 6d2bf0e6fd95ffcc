"""One insertion, synchronous and free of I/O: messages and frames in, messages out.

The same object runs in real time (called by the service's perception thread, the networks in another one) and in lock
step (called by the simulator). The caller supplies the time: ``now_ns`` is on the clock of ``captured_ns``.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from service.contract import FramePair, TactileFrame, wire
from service.contract.replies import beat, clock, ending, unspoken
from service.contract.wire import CameraEntry, ControllerName, Limits, ServiceMessage
from service.decision.attempt import Attempt, Stage, WorkResult
from service.decision.claim import Doubts, unclaimed
from service.decision.controllers import Command
from service.decision.models import ModelSet
from service.decision.work import Work, enough_message, plan, slip_message
from service.perception.observation import FingerWatch, Observation
from service.session.decider import Decider, Decision, decider_of
from service.session.fingers import Fingers
from service.session.learn_open import OpenGels
from service.settings import Deadlines

Replies = list[ServiceMessage]
DEFAULT_LIMITS = Limits(max_dx_mm=15.0, max_dtheta_deg=15.0, max_frame_age_ms=500.0)


def ignore(_: Any) -> None:
    """Default observer: does nothing, and knows nothing."""


@dataclass(slots=True)
class InsertionSession:
    """State machine of one insertion; :mod:`service.contract.wire` has the order of messages. Not thread safe.

    ``submit`` hands network work to another thread, whose result comes back through :meth:`on_result`; without it the
    work runs at once. ``on_observation`` receives each observation, ``on_attempt`` each attempt when it is decided or
    ends, both for recording and display.
    """

    models: ModelSet
    left: FingerWatch
    right: FingerWatch
    controller_name: ControllerName = "belief"
    limits: Limits = DEFAULT_LIMITS
    deadlines: Deadlines = field(default_factory=Deadlines)
    cameras: Callable[[], tuple[CameraEntry, ...]] = tuple
    age_ms: Callable[[int], float | None] = ignore
    submit: Callable[[Work], None] | None = None
    on_observation: Callable[[Observation], None] = ignore
    on_attempt: Callable[[Attempt], None] = ignore
    on_command: Callable[[Command], None] = ignore
    insertion_id: str | None = None
    takes_afresh: bool = False
    inserts: bool = True
    continues: bool = False
    most_tilt_deg: float = 0.0
    attempt: Attempt | None = None
    finished: wire.Finished | None = None
    recording: str | None = None
    decider: Decider | None = None
    _fingers: Fingers = field(init=False)
    _generation: int = 0
    open_gels: OpenGels = field(default_factory=OpenGels)

    def __post_init__(self) -> None:
        self._fingers = Fingers(self.left, self.right)

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
                replies = [beat(message, now_ns, self.age_ms(now_ns))]
            case _ if self.finished is not None:
                replies = [self.finished]
            case wire.Abort():
                replies = self._finish(message.cause, self._fingers.unjudged() if message.cause == "unwatched" else ())
            case wire.LearnOpen() if self.attempt is None or self.attempt.stage is Stage.DECIDED:
                self.open_gels.ask(message, (self.left, self.right), now_ns)
            case _:
                replies = self._on_attempt_message(message, now_ns)
        return replies

    def _on_attempt_message(self, message: Any, now_ns: int) -> Replies:
        match message:
            case wire.Arm():
                return self._arm(message, now_ns)
            case wire.Descending():
                return self._descending(message, now_ns)
            case wire.Stopped():
                return self._stopped(message, now_ns)
        return [self._fault("protocol", f"{message.type} while an attempt is under way")]  # it would not be watched

    def _hello(self, message: wire.ClientHello, now_ns: int) -> Replies:
        if refused := unspoken(message):
            return [refused]
        if self.insertion_id is None:
            self.insertion_id, self.continues = message.insertion_id, message.continues is not None
            self.most_tilt_deg = message.most_tilt_deg
            self.takes_afresh, self.inserts = message.takes_afresh, message.purpose == "insert"
            regrasped = self.decider and self.decider.controller.name
            self.controller_name = regrasped or message.controller or self.controller_name
        answer = wire.ServiceHello(
            insertion_id=self.insertion_id,
            clock=clock(message, now_ns),
            models=self.models.entries,
            cameras=self.cameras(),
            controller=self.controller_name,
            limits=self.limits,
        )
        return [answer]

    def _arm(self, message: wire.Arm, now_ns: int) -> Replies:
        last = self.attempt.arm.attempt if self.attempt else 0
        decided = self.attempt is None or self.attempt.stage is Stage.DECIDED
        if (attempt := self.attempt) and message.attempt == last and (attempt.refused or not decided):
            unused = attempt.stage is Stage.ARMED and not attempt.spoilt and attempt.descending_ns is None
            if answer := attempt.refused or (attempt.armed if unused else None):
                return [answer]
            if self.decider:
                self.decider.given_up(attempt)
        elif message.attempt != last + 1 or not decided:
            why = f"attempt {last} is {'decided' if decided else 'not decided yet'}" if last else "none has begun"
            return [self._fault("protocol", f"arm of attempt {message.attempt}, expected {last + decided}: {why}")]
        if self.decider is None or not self.inserts:  # a probe's next error does not follow from the one before
            before = self.decider
            self.decider = decider_of(message, self.models, self.controller_name, self.limits, self.deadlines, before)
        if (anew := self.open_gels.grasped_anew()) or message.attempt == 1:
            self.decider.grasps(message, self.open_gels.unknown, anew=anew, tried=self.continues)
        self._generation += 1
        tilt = self.decider.grasp.tilt.held_at(message.tilt_deg, self.most_tilt_deg)
        self.attempt = Attempt(message, now_ns, self._generation, tilt, self.inserts)
        return [*self.decider.before_descending(self.attempt)]

    def _descending(self, message: wire.Descending, now_ns: int) -> Replies:
        if self.attempt and self._is_current(message.attempt, {Stage.ARMED}):
            self.attempt.descends(message, now_ns)
            return []
        return [self._fault("protocol", f"descending in attempt {message.attempt}, which is not armed; send arm first")]

    def _stopped(self, message: wire.Stopped, now_ns: int) -> Replies:
        attempt = self.attempt
        if attempt and message.attempt == attempt.arm.attempt and attempt.decision:
            return [attempt.decision]
        if attempt is None or not self._is_current(message.attempt, {Stage.ARMED, Stage.STOPPED}):
            return [self._fault("protocol", f"stopped in attempt {message.attempt}, which is not armed")]
        if message.outcome == "dropped":
            attempt.ends(message)
            return self._end(attempt, "part_lost")
        if attempt.stage is Stage.ARMED:  # repeated, it changes nothing
            attempt.ends(message)
            attempt.stage, attempt.reported_ns = Stage.STOPPED, now_ns
            attempt.stopped_ns = now_ns - round(message.still_s * 1e9)
        return self._conclude(now_ns)

    def _is_current(self, number: int, stages: set[Stage]) -> bool:
        return self.attempt is not None and number == self.attempt.arm.attempt and self.attempt.stage in stages

    # ---- frames, and what the networks make of them -----------------------------------------------------------------

    @property
    def wants_frames(self) -> bool:
        """Whether an attempt is under way; frames between attempts, while the arm moves freely, are not used."""
        under_way = self.attempt is not None and self.attempt.stage not in {Stage.STRAIGHTENING, Stage.DECIDED}
        return (under_way or self.open_gels.waiting) and self.finished is None

    @property
    def watches_slip(self) -> bool:
        """Whether the arm may be moving, so that a late slip message would mean a collision."""
        return self.attempt is not None and self.attempt.stage is Stage.ARMED and not self.attempt.slip_sent

    def prime(self, frame: TactileFrame) -> None:
        """Let a finger's tracker find its grid before time matters: the search takes some 20 ms, tracking 2 ms."""
        self._fingers.watch(frame.finger).observe(frame)

    def on_frame(self, frame: TactileFrame, now_ns: int) -> Replies:
        """Perceive one finger's frame; report slip at once, otherwise that both fingers are watched."""
        attempt, watch = self.attempt, self._fingers.watch(frame.finger)
        if self.open_gels.waiting:
            return self.open_gels.take(str(self.insertion_id), watch, frame)
        if attempt is None or not self.wants_frames:
            return []
        attempt.rearm(watch, frame)
        attempt.unread(observation := self._fingers.observe(frame))
        self.on_observation(observation)
        if attempt.stage is not Stage.ARMED or attempt.slip_sent:
            return []
        if not observation.slip.stop:
            return [*attempt.watching(observation, now_ns)]
        attempt.stops(observation.captured_ns)
        return [slip_message(attempt, observation, now_ns)]

    def on_pair(self, pair: FramePair, now_ns: int) -> Replies:
        """Process both fingers' frames of one instant: slip, reference, onset, and the frames of the decision."""
        if self.open_gels.waiting:
            return [*self.on_frame(pair.left, now_ns), *self.on_frame(pair.right, now_ns)]
        attempt = self.attempt
        if attempt is None or not self.wants_frames:
            return []
        replies = [answer for frame in self._fingers.missing(pair) for answer in self.on_frame(frame, now_ns)]
        if attempt.stage is Stage.ARMING:
            reference = attempt.take_reference(self._fingers.both())
            return [*replies, reference] if reference else replies
        lost, both = self._fingers.emptied(attempt), self._fingers.of(pair)
        if lost or both is None:
            return [*replies, self._fault("part_lost", lost)] if lost else replies
        attempt.take_in(both)
        if attempt.outcome == "inserted":
            return replies + self._conclude(now_ns)
        replies += [answer for work in plan(self.models, attempt) for answer in self._submit(work, now_ns)]
        return [*replies, *enough_message(attempt)]

    def _submit(self, work: Work, now_ns: int) -> Replies:
        if self.submit is not None:
            self.submit(work)
            return []
        return self.on_result(result, now_ns) if (result := work.run()) else []

    def on_result(self, result: WorkResult, now_ns: int) -> Replies:
        """Take a result of the networks; those of another insertion, attempt or arming are dropped."""
        attempt = self.attempt
        if attempt is None or not attempt.awaits(result) or self.finished is not None:
            return []
        attempt.result = attempt.result or result
        return self._conclude(now_ns)

    def on_camera_fault(self, code: wire.FaultCode, detail: str) -> Replies:
        """A camera failed: the client must hold, and an attempt under way needs a new reference."""
        if not self.wants_frames:
            return []
        if self.attempt is not None and self.attempt.stage is Stage.ARMED:
            self.attempt.broken = detail
        return [self._fault(code, detail)]

    # ---- decisions ------------------------------------------------------------------------------------------------

    def on_tick(self, now_ns: int) -> Replies:
        """Check deadlines and the age of the newest frame; call it a few times per second."""
        attempt = self.attempt
        if self.open_gels.waiting:
            return self.open_gels.overdue(str(self.insertion_id), now_ns, self.deadlines.reference_s)
        if attempt is None or self.finished is not None:
            return []
        if attempt.stage is Stage.ARMING and now_ns - attempt.armed_ns > self.deadlines.reference_s * 1e9:
            return [attempt.refusal("no_reference", attempt.problem or "no frame pair arrived")]
        return self._conclude(now_ns) if attempt.stage is Stage.STOPPED else self._check_age(attempt, now_ns)

    def _check_age(self, attempt: Attempt, now_ns: int) -> Replies:
        why = self._fingers.stale(now_ns, self.limits.max_frame_age_ms)
        if attempt.stage is not Stage.ARMED or attempt.stale_sent or not why:
            return []
        attempt.stale_sent = True
        return [self._fault("stale_frames", why)]

    def _conclude(self, now_ns: int) -> Replies:
        if self.attempt is None or self.decider is None:
            return []
        if self.attempt.outcome == "inserted":
            doubts = self.decider.doubts(self.attempt, now_ns)
            cause = unclaimed(doubts or (), afresh=self.takes_afresh)
            return [] if doubts is None else self._end(self.attempt, cause, doubts)
        decision = self.decider.conclude(self.attempt, now_ns)
        if command := self.decider.command:
            self.on_command(command)
        return [] if decision is None else self._decided(self.attempt, decision)

    def _decided(self, attempt: Attempt, decision: Decision) -> Replies:
        attempt.stage, attempt.decision = Stage.DECIDED, decision
        self.on_attempt(attempt)
        return [decision, *(self._finish("attempts") if attempt.arm.attempt >= wire.MAX_ATTEMPTS else [])]

    def _end(self, attempt: Attempt, cause: wire.Cause | None = None, doubts: Doubts = ()) -> Replies:
        attempt.stage = Stage.DECIDED
        self.on_attempt(attempt)
        return self._finish(cause, doubts)

    def _finish(self, cause: wire.Cause | None, doubts: Doubts = ()) -> Replies:
        """Close the insertion: inserted if there are no doubts."""
        self.finished = wire.Finished(
            insertion_id=str(self.insertion_id),
            outcome=ending(cause),
            attempts=self.attempt.arm.attempt if self.attempt else 0,
            cause=cause,
            doubts=doubts,
            recording=self.recording,
        )
        return [self.finished]

    def _fault(self, code: wire.FaultCode, detail: str, named: str | None = None) -> wire.Fault:
        return wire.Fault(insertion_id=named or self.insertion_id or "none", code=code, detail=detail, fatal=False)
