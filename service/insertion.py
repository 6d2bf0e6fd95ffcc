"""A running insertion: the session with its recorder, its driving client and everyone who watches."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from service.attempt import Attempt, WorkResult
from service.cameras import CameraFrame, now_ns
from service.contract import Finger, FramePair, wire
from service.contract.wire import ServiceMessage
from service.insertion_session import InsertionSession, Replies, ignore
from service.observation import Observation
from service.recording import Recorder

Send = Callable[[ServiceMessage], None]


@dataclass(slots=True)
class Insertion:
    """Feeds a session, records what it is told and what it says, and passes its messages on.

    Only the perception thread calls its methods. ``send`` is the driving client (None while it is away); ``publish``
    takes (kind, content) for watchers and metrics, ``show`` each observation. The client hears first, then those who
    watch, then it is written down: each of the three wakes a thread that may take this one's core.
    """

    session: InsertionSession
    recorder: Recorder | None
    send: Send | None
    publish: Callable[[str, Any], None]
    show: Callable[[Observation], None] = ignore
    heard_ns: int = field(default_factory=now_ns)
    closing: bool = False
    recorded_seq: dict[Finger, int] = field(default_factory=dict)
    _observed: list[Observation] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Listen to the session."""
        self.session.on_attempt = self.attempt_decided
        self.session.on_observation = self._observed.append

    @property
    def wants_frames(self) -> bool:
        """Whether an attempt is under way; frames between attempts are neither perceived nor recorded."""
        return self.session.wants_frames

    def message(self, message: Any) -> None:
        """A message of the driving client."""
        now = self.heard_ns = now_ns()
        if self.recorder and message.type != "heartbeat":
            content = message.model_dump(mode="json")
            self.recorder.message("client", content, now)
            self.recorder.call({"call": "message", "message": content}, now)
        self._emit(self.session.handle(message, now), now)

    def prime(self, frame: CameraFrame) -> None:
        """Show the trackers a first frame."""
        self._record(frame)
        self._call({"call": "prime", "finger": frame.frame.finger, "seq": frame.frame.seq}, now_ns())
        self.session.prime(frame.frame)

    def _record(self, frame: CameraFrame) -> None:
        """Record a frame once; a pair may hold one that came before the attempt or was dropped from the queue."""
        finger, seq = frame.frame.finger, frame.frame.seq
        if self.recorder and seq > self.recorded_seq.get(finger, -1):
            self.recorded_seq[finger] = seq
            self.recorder.frame(frame)

    def frame(self, frame: CameraFrame, pair: FramePair | None) -> None:
        """A camera frame, and the pair it completes, if any."""
        now = now_ns()
        slip: Replies = []
        try:
            slip = self._tell(self.session.on_frame(frame.frame, now))
            self._show()
        finally:
            self._record(frame)
            self._call({"call": "frame", "finger": frame.frame.finger, "seq": frame.frame.seq}, now)
            self._write(slip, now)
        if pair is not None:
            for half in (pair.left, pair.right):
                self._record(CameraFrame(half, None))
            now = now_ns()
            self._call({"call": "pair", "left": pair.left.seq, "right": pair.right.seq}, now)
            self._emit(self.session.on_pair(pair, now), now)
            self._show()

    def result(self, result: WorkResult) -> None:
        """What the networks said."""
        now = now_ns()
        self._call({"call": "result", "generation": result.generation}, now)
        self._emit(self.session.on_result(result, now), now)

    def tick(self) -> None:
        """Time passed: deadlines."""
        now = now_ns()
        replies = self.session.on_tick(now)
        if replies:
            self._call({"call": "tick"}, now)
        self._emit(replies, now)

    def camera_fault(self, code: str, detail: str) -> None:
        """A camera went bad in the middle of an insertion."""
        now = now_ns()
        self._call({"call": "camera_fault", "code": code, "detail": detail}, now)
        self._emit(self.session.on_camera_fault(code, detail), now)

    def attempt_decided(self, attempt: Attempt) -> None:
        """Keep the frames the decision rests on."""
        arrays = attempt.arrays()
        if self.recorder and arrays and attempt.decision is not None:
            self.recorder.attempt(attempt.arm.attempt, arrays)

    def _call(self, value: dict[str, Any], now: int) -> None:
        if self.recorder:
            self.recorder.call(value, now)

    def _emit(self, replies: Replies, now: int) -> None:
        for answer in replies:
            if isinstance(answer, wire.Finished):
                self._write([answer], now)
                self.publish("message", answer)
                self.closing = True
                self.publish("finished", answer)
            else:
                self._write(self._tell([answer]), now)

    def _tell(self, replies: Replies) -> Replies:
        """Send replies to the client and those who watch; returns what there is to write down, as it was sent."""
        told: Replies = []
        for answer in replies:
            reply = with_current_age(answer)
            self._deliver(reply)
            if not isinstance(reply, wire.ServiceHeartbeat):
                self.publish("message", reply)
                told.append(reply)
        return told

    def _write(self, told: Replies, now: int) -> None:
        if self.recorder and not self.closing:
            for reply in told:
                self.recorder.message("service", reply.model_dump(mode="json"), now)

    def _show(self) -> None:
        """Pass on what was observed; recorded, and shown to those who watch."""
        for observation in self._observed:
            self.show(observation)
            if self.recorder:
                self.recorder.observation(observation)
        self._observed.clear()

    def _deliver(self, reply: ServiceMessage) -> None:
        if self.send is not None:
            self.send(reply)


def with_current_age(message: ServiceMessage) -> ServiceMessage:
    """The same message; a slip's age is measured at the moment of sending."""
    if isinstance(message, wire.Slip):
        return message.model_copy(update={"age_ms": (now_ns() - message.captured_ns) / 1e6})
    return message
