"""A running insertion: the session with its recorder, its driving client and its watchers."""

import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from service.cameras.capture import CameraFrame, now_ns
from service.contract import Finger, FramePair, wire
from service.contract.wire import ServiceMessage
from service.decision.attempt import Attempt, Stage, WorkResult
from service.decision.seating import strongest_push
from service.decision.work import arrays_of
from service.perception.observation import Observation
from service.recordings.writer import TASK, Recorder
from service.session.fingers import gels_of
from service.session.state_machine import InsertionSession, Replies, ignore
from service.versions.beside import Beside

Send = Callable[[ServiceMessage], None]
LET_GO_S = 0.0005  # a thread that keeps computing holds the interpreter lock that the sending thread needs
HOLD_S = 0.1  # longest delay of recording, apart from a tick


@dataclass(slots=True)
class Insertion:
    """Feeds a session, records its input and output, and passes its messages on.

    Only the perception thread calls its methods. ``send`` is the driving client (None while it is away); ``publish``
    takes (kind, content) for watchers and metrics, ``show`` each observation, ``jpegs`` holds the JPEGs of recent
    frames.

    A message goes to the client first, then to watchers, then into the recording: each of the three wakes a thread that
    may take this one's core. Messages just before an answer are recorded after it, at most ``HOLD_S`` later.
    """

    session: InsertionSession
    recorder: Recorder | None
    send: Send | None
    publish: Callable[[str, Any], None]
    show: Callable[[Observation], None] = ignore
    received_ns: int = field(default_factory=now_ns)
    recorded: set[tuple[Finger, int]] = field(default_factory=set)
    jpegs: Mapping[tuple[Finger, int], bytes | None] = field(default_factory=dict)
    episode: wire.Episode | None = None
    telemetry_lost_n: int = 0
    opened_ns: int = field(default_factory=now_ns)
    continues: wire.InsertionId | None = None
    tried_n: int = 0  # attempts with the object in its earlier grasps
    beside: Beside | None = None
    _decisions: list[dict[str, Any]] = field(default_factory=list)
    _client_ahead_ns: int | None = None
    _observed: list[Observation] = field(default_factory=list)
    _later: deque[Callable[[], None]] = field(default_factory=deque)
    _sent: bool = False
    _settled_ns: int = field(default_factory=now_ns)

    def __post_init__(self) -> None:
        self.session.on_attempt = self.attempt_decided
        self.session.on_observation = self._observed.append

    @property
    def wants_frames(self) -> bool:
        """Whether an attempt is under way; frames between attempts are neither perceived nor recorded."""
        return self.session.wants_frames

    def message(self, message: Any) -> None:
        now = self.received_ns = now_ns()
        if isinstance(message, wire.Telemetry):
            self._robot(message, now)
            return
        if isinstance(message, wire.Episode):
            self.episode = message
            self._later.append(partial(self.publish, "client", message))
            self._note(_record_message, "client", message, now)
            return
        if message.type != "heartbeat":
            self._note(_record_received, message, now)
            self._later.append(partial(self.publish, "client", message))
        self._emit(self.session.handle(message, now), now)
        self._settle()

    def _robot(self, message: wire.Telemetry, now: int) -> None:
        """Record the robot's pose on this machine's clock; the fastest message gives the best clock offset.

        The error is the transit time of the fastest message, a fraction of a millisecond on one machine.
        """
        ahead_ns = message.sent_ns - now
        self._client_ahead_ns = max(ahead_ns, self._client_ahead_ns if self._client_ahead_ns is not None else ahead_ns)
        self.telemetry_lost_n += message.left_out_n
        for sample in message.samples:
            self._note(Recorder.robot, sample, sample.at_ns - self._client_ahead_ns)
        if message.samples:
            self._later.append(partial(self.publish, "robot", message.samples[-1]))
        self._settle_unless_near(now, paired=False)

    @property
    def object(self) -> str:
        """The object by its client, empty where that does not say."""
        return self.episode.object if self.episode else ""

    @property
    def facts(self) -> dict[str, Any]:
        """Facts about the task for the summary."""
        episode = self.episode
        task = {} if episode is None else episode.model_dump(mode="json", include=set(TASK), exclude_none=True)
        seconds = round((now_ns() - self.opened_ns) / 1e9, 2)
        lost_n = self.telemetry_lost_n
        task |= {"continues": self.continues} if self.continues else {}
        task |= {"earlier_n": self.tried_n} if self.tried_n else {}
        task |= {"seconds": seconds, "decisions": self._decisions, "robot_samples_lost_n": lost_n}
        return task | gels_of((self.session.left, self.session.right), self.session.attempt)

    @property
    def held_over(self) -> str:
        """What it holds over to the next insertion, see `OpenGels`."""
        return self.session.open_gels.after(self.session.attempt)

    def prime(self, frame: CameraFrame) -> None:
        """Show the trackers a first frame."""
        self._record(frame)
        self._call({"call": "prime", "finger": frame.frame.finger, "seq": frame.frame.seq}, now_ns())
        self.session.prime(frame.frame)
        self._settle()

    def frame(self, frame: CameraFrame, pair: FramePair | None) -> None:
        """A camera frame, and the pair it completes, if any."""
        now = now_ns()
        slip: Replies = []
        try:
            slip = self._send_all(self.session.on_frame(frame.frame, now))
            self._show()
        finally:
            self._record(frame)
            self._call({"call": "frame", "finger": frame.frame.finger, "seq": frame.frame.seq}, now)
            self._write(slip, now)
        if pair is not None:
            for half in (pair.left, pair.right):
                self._record(CameraFrame(half, self.jpegs.get((half.finger, half.seq))))
            now = now_ns()
            self._call({"call": "pair", "left": pair.left.seq, "right": pair.right.seq}, now)
            self._emit(self.session.on_pair(pair, now), now)
            self._show()
        self._settle_unless_near(now, paired=pair is not None)

    def result(self, result: WorkResult) -> None:
        now = now_ns()
        self._call({"call": "result", "generation": result.generation}, now)
        self._emit(self.session.on_result(result, now), now)
        self._settle()

    def tick(self) -> None:
        now = now_ns()
        replies = self.session.on_tick(now)
        if replies:
            self._call({"call": "tick"}, now)
        self._emit(replies, now)
        self._settle_unless_near(now, paired=False)

    def camera_fault(self, code: wire.FaultCode, detail: str) -> None:
        now = now_ns()
        self._call({"call": "camera_fault", "code": code, "detail": detail}, now)
        self._emit(self.session.on_camera_fault(code, detail), now)
        self._settle()

    def attempt_decided(self, attempt: Attempt) -> None:
        """Keep the frames of the decision; a decided attempt no longer changes, so they may be gathered later."""
        if attempt.decision is not None:
            self._decisions.append(facts := _facts_of(attempt, attempt.decision))
            self._note(Recorder.attempt, attempt.arm.attempt, partial(arrays_of, attempt))
            if self.beside:
                self._note(Recorder.work_out, "/beside", partial(_answers, self.beside, attempt, facts), now_ns())

    # ---- work that can wait until the client has its answer ---------------------------------------------------------

    def _settle_unless_near(self, now: int, *, paired: bool) -> None:
        """Settle, unless the answer may come next; nothing waits for long."""
        attempt = self.session.attempt
        near = attempt is not None and attempt.stage is Stage.STOPPED and (attempt.fed or not paired)
        if not near or now - self._settled_ns > HOLD_S * 1e9:
            self._settle()

    def _settle(self) -> None:
        """Publish and record what is pending; first yield to the thread that sends to the client."""
        if self._sent and self._later:
            time.sleep(LET_GO_S)
        self._sent, self._settled_ns = False, now_ns()
        while self._later:
            self._later.popleft()()

    def _note(self, write: Callable[..., None], *content: Any) -> None:
        """Record later: ``write`` is called with the recorder and ``content``."""
        if self.recorder:
            self._later.append(partial(write, self.recorder, *content))

    def _record(self, frame: CameraFrame) -> None:
        """Record a frame once; a pair may hold one from before the attempt, or one dropped from the queue.

        The dropped one may come after newer ones of its finger: on a busy machine its partner arrives late.
        """
        named = frame.frame.finger, frame.frame.seq
        if self.recorder and named not in self.recorded:
            self.recorded.add(named)
            self._note(Recorder.frame, frame)

    def _call(self, value: dict[str, Any], now: int) -> None:
        self._note(Recorder.call, value, now)

    def _write(self, sent: Replies, now: int) -> None:
        for reply in sent:
            self._note(_record_message, "service", reply, now)

    # ---- messages ---------------------------------------------------------------------------------------------------

    def _emit(self, replies: Replies, now: int) -> None:
        for answer in replies:
            if isinstance(answer, wire.Finished):
                self._write([answer], now)
                self._settle()
                self.publish("message", answer)
                self.publish("finished", answer)
            else:
                self._write(self._send_all([answer]), now)

    def _send_all(self, replies: Replies) -> Replies:
        """Send replies to the client and queue them for watchers; returns the messages as sent, for the recording."""
        sent: Replies = []
        for answer in replies:
            reply = with_current_age(answer)
            if self.send is not None:
                self.send(reply)
            if isinstance(reply, wire.ServiceHeartbeat):
                continue
            sent.append(reply)
            if isinstance(reply, wire.Slip | wire.Enough):
                self._later.append(partial(self.publish, "stop_age_s", (now_ns() - reply.captured_ns) * 1e-9))
            if not isinstance(reply, wire.Watching):  # one per pair of frames: watchers see the frames themselves
                self._sent = True
                self._later.append(partial(self.publish, "message", reply))
        return sent

    def _show(self) -> None:
        for observation in self._observed:
            self.show(observation)
            self._note(Recorder.observation, observation)
        self._observed.clear()


def _facts_of(attempt: Attempt, decision: wire.Correction | wire.NoDecision) -> dict[str, Any]:
    """Facts about a decided attempt for the summary (see :class:`service.recordings.listing.Decided`)."""
    facts: dict[str, Any] = {"attempt": attempt.arm.attempt, "type": decision.type, "depth_mm": attempt.depth_mm}
    facts["reach_pitch"] = strongest_push(attempt.pushes)
    if isinstance(decision, wire.NoDecision):
        return facts | {"reason": decision.reason}
    felt = decision.estimate
    moved = {"correction": (decision.dx_mm, decision.dtheta_deg), "confidence": decision.confidence}
    return facts | moved | {"interval_x_mm": felt.interval_x_mm, "interval_theta_deg": felt.interval_theta_deg}


def _answers(beside: Beside, attempt: Attempt, facts: dict[str, Any]) -> dict[str, Any]:
    """Answers of other versions, for the recording and, since ``facts`` are written last, for its summary."""
    facts["beside"] = beside.decide(attempt)
    return {"attempt": attempt.arm.attempt, "active": beside.active, "answers": facts["beside"]}


def _record_message(recorder: Recorder, sender: str, message: Any, now: int) -> None:
    recorder.message(sender, message.model_dump(mode="json"), now)


def _record_received(recorder: Recorder, message: Any, now: int) -> None:
    content = message.model_dump(mode="json")
    recorder.message("client", content, now)
    recorder.call({"call": "message", "message": content}, now)


def with_current_age(message: ServiceMessage) -> ServiceMessage:
    """The same message; a slip's age is measured at the moment of sending."""
    if isinstance(message, wire.Slip):
        return message.model_copy(update={"age_ms": (now_ns() - message.captured_ns) / 1e6})
    return message
