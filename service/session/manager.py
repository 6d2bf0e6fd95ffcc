"""The insertion under way: how it opens, which client drives it, how it ends and what is kept of it.

Only the perception thread calls a manager's methods; only the closing of a recording happens outside it.
"""

import json
import platform
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
import onnxruntime

from service import __version__
from service.cameras.capture import Camera, frame_age_ms, now_ns
from service.contract import Finger, wire
from service.contract.refusals import reason
from service.contract.replies import beat, descended_n
from service.decision.models import ModelSet
from service.decision.work import Work
from service.observability.charts import Charts
from service.observability.hub import Hub
from service.perception.identity import gel_names
from service.perception.rectification import Calibration
from service.recordings.listing import Summary
from service.recordings.retention import largest_bytes, make_room, problem_of
from service.recordings.writer import CONFIGURATION, Recorder
from service.session.decider import Decider
from service.session.factory import make_session
from service.session.insertion import Insertion, Send
from service.session.learn_open import STARTED
from service.session.memory import give_back
from service.session.state_machine import InsertionSession, ignore
from service.settings import Settings
from service.versions.versions import Versions

LIBRARIES = {"numpy": np, "onnxruntime": onnxruntime, "opencv": cv2}
VERSIONS = {"service": __version__, "protocol": str(wire.PROTOCOL), "python": platform.python_version()}
VERSIONS |= {name: library.__version__ for name, library in LIBRARIES.items()}
CHARTS = "charts.json"
REMEMBERED_N = 256  # ended insertions whose `finished` is sent again to a client that missed it


@dataclass(slots=True)
class InsertionManager:
    """Opens, hands over and closes insertions; the next one decides with ``models``."""

    settings: Settings
    models: ModelSet
    calibration: Calibration | None
    cameras: Mapping[Finger, Camera]
    hub: Hub
    submit: Callable[[Work], None]
    versions: Versions | None = None
    active: Insertion | None = None
    opened_n: int = 0
    jpegs: dict[tuple[Finger, int], bytes | None] = field(default_factory=dict)
    unrecorded_n: int = 0
    frames_unrecorded_n: int = 0
    _unrecorded: str = ""
    held_over: str = STARTED  # see `OpenGels`
    _decided: Decider | None = None  # of the last insertion: the next one may continue with its object
    _tried_n: int = 0  # attempts with that object so far
    ended: OrderedDict[str, wire.Finished] = field(default_factory=OrderedDict)
    closing: threading.Thread | None = None  # keeps the insertion that ended last
    _calibration_text: str = field(init=False)
    _gels: dict[Finger, str] = field(init=False)
    charts: Charts = field(init=False)

    def __post_init__(self) -> None:
        """Read the calibration file once: it may change or disappear later."""
        self._calibration_text = self.settings.calibration.read_text() if self.settings.calibration else ""
        self.charts = Charts(self.settings.recordings / CHARTS)
        self._gels = gel_names(self.calibration)
        make_room(self.settings.recordings, self.settings.recordings_max_bytes)  # the limit may be a lower one now

    @property
    def recording_problem(self) -> str:
        """What keeps insertions from being recorded now; "" if nothing does, whatever befell the last one."""
        recorder = active.recorder if (active := self.active) else None  # asked by other threads
        return (_lacks(recorder, recorder.error) if recorder else "") or problem_of(self.settings.recordings)

    @property
    def unrecorded(self) -> str:
        """What the recording under way, else the last one, lacks, or what keeps the next from being made; or ""."""
        now = self.recording_problem  # first: a disk that hangs answers nobody, whatever befell the last insertion
        recorder = active.recorder if (active := self.active) else None  # asked by other threads
        return (_lacks(recorder, recorder.problem) if recorder else "") or self._unrecorded or now

    def _note_recorded(self, problem: str) -> None:
        """Note that an insertion was recorded whole, or the problem."""
        self._unrecorded = problem
        if problem:
            self.unrecorded_n += 1
            self.hub.publish("unrecorded", problem)

    def camera_entries(self) -> tuple[wire.CameraEntry, ...]:
        return tuple(
            camera.entry.model_copy(update={"gel": self._gels.get(finger, "")})
            for finger, camera in self.cameras.items()
        )

    def connect(self, hello: wire.ClientHello, send: Send) -> None:
        """Connect a client that wants to drive: open an insertion, or resume its own one after a lost connection."""
        if ended := self.ended.get(hello.insertion_id):  # the client that drives now is not disturbed
            send(ended)
            return
        active = self.active
        if active and active.session.insertion_id != hello.insertion_id:
            if active.send is not None:
                detail = f"insertion {active.session.insertion_id} is under way; wait, or connect with role watch"
                send(wire.Fault(insertion_id=hello.insertion_id, code="busy", detail=detail, fatal=True))
                return
            self.abort("link", "another client takes over after a lost connection")
            active = None
        if active is None:
            try:
                active = self._open(hello)
            except Exception as error:  # else the client would wait for a hello that never comes
                detail = f"no insertion can be opened: {reason(error)}"
                self.hub.publish("error", detail)
                send(wire.Fault(insertion_id=hello.insertion_id, code="not_ready", detail=detail, fatal=True))
                return
        if active.send is not None and active.send != send:  # from now on it would get no slip messages
            detail = "another connection drives this insertion now; hold"
            active.send(wire.Fault(insertion_id=hello.insertion_id, code="taken_over", detail=detail, fatal=True))
        active.send = send
        active.message(hello)

    def receive(self, message: Any, send: Send) -> None:
        """Handle a message of a client; ignored unless ``send`` is the driving connection."""
        if self.active and self.active.send == send:
            self.active.message(message)
        elif isinstance(message, wire.ClientHeartbeat) and message.insertion_id in self.ended:
            # while its recording is being closed, a client that waits for `finished` must still hear something
            send(beat(message, now_ns(), None))

    def disconnect(self, send: Send) -> None:
        """Note that a client's connection is lost; its insertion waits for it for ``client_timeout_s``."""
        if self.active and self.active.send == send:  # bound methods are equal, not the same
            self.active.send = None

    def result(self, result: Any) -> None:
        if self.active:
            self.active.result(result)

    def fault(self, code: wire.FaultCode, detail: str) -> None:
        if self.active:
            self.active.camera_fault(code, detail)

    def tick(self, at_ns: int) -> None:
        if self.active:
            self.active.tick()
        if self.active and (at_ns - self.active.received_ns) * 1e-9 > self.settings.client_timeout_s:
            self.abort("link", "the driving client fell silent")

    def abort(self, cause: wire.Cause, reason: str) -> None:
        """End the insertion under way, if any; its recording is kept."""
        active = self.active
        if active and active.session.insertion_id:
            active.message(wire.Abort(insertion_id=active.session.insertion_id, cause=cause, reason=reason))

    def _open(self, hello: wire.ClientHello) -> Insertion:
        given, before = self.settings, self._decided
        if before and before.insertion_id != hello.continues:
            before = None
        if self.versions and not before:  # a continued insertion is decided by the version that began it
            self.models = self.versions.active
        session = make_session(
            self.models, self.calibration, given.controller, given.limits, imprint=given.imprint_slip
        )
        session.cameras, session.submit = self.camera_entries, self.submit
        session.age_ms = lambda at_ns: frame_age_ms(self.cameras.values(), at_ns)
        if before and before.models is not session.models:
            before = None
        session.decider = before and before.afresh(hello.insertion_id)
        session.open_gels.held_over = self.held_over
        session.deadlines = self.settings.deadlines
        recorder = self._recorder(hello.insertion_id, session, before.insertion_id if before else "")
        self.jpegs = {}
        insertion = Insertion(session, recorder, None, self._publish, self.hub.observation, jpegs=self.jpegs)
        insertion.continues, insertion.tried_n = hello.continues, self._tried_n if before else 0
        if self.versions and recorder:  # an insertion without a recording is no evidence
            insertion.beside = self.versions.beside(session.models, given.limits, given.controller)
        session.on_command = lambda command: self.hub.publish("command", command)
        session.recording = str(recorder.path) if recorder else None
        try:
            for camera in self.cameras.values():
                if camera.latest:
                    insertion.prime(camera.latest)
        except Exception:
            if recorder:
                recorder.close({"outcome": "failed", "cause": "service", "attempts": 0})
            raise
        self.active = insertion
        self.opened_n += 1
        return insertion

    def _recorder(self, insertion_id: str, session: InsertionSession, continues: str) -> Recorder | None:
        root = self.settings.recordings
        facts = {
            "controller": self.settings.controller,
            "limits": self.settings.limits.model_dump_json(),
            "versions": json.dumps(VERSIONS),
            "models": " ".join(f"{entry.card.name}:{entry.sha256}" for entry in session.models.entries),
            "models_folder": str(session.models.steps[0].path.parent),
            "calibration": self._calibration_text,
            "continues": continues,
            "held_over": session.open_gels.held_over,
        }
        try:
            largest = largest_bytes(self.settings.recordings_max_bytes)
            return Recorder(root, insertion_id, facts, largest, self._attachments(session))
        except OSError as error:
            self._note_recorded(f"cannot record into {root}: {reason(error)}")
            return None

    def _attachments(self, session: InsertionSession) -> dict[str, bytes]:
        """The setup behind the decisions: settings, calibration, cards. Tokens are omitted."""
        secrets = {"token_watch", "token_drive", "token_admin"}
        attached = {CONFIGURATION: self.settings.model_dump_json(exclude=secrets, indent=1).encode()}
        if self._calibration_text:
            attached["calibration.toml"] = self._calibration_text.encode()
        cards = {f"{entry.card.name}.card.json": entry.card for entry in session.models.entries}
        return attached | {name: card.model_dump_json(indent=1).encode() for name, card in cards.items()}

    def _publish(self, kind: str, content: Any) -> None:
        self.hub.publish(kind, content)
        if kind == "finished":
            self._close(content)

    def _close(self, finished: wire.Finished) -> None:
        """Close the recording outside this thread; the client gets `finished` when it is complete."""
        insertion, self.active = self.active, None
        if insertion is None:
            return
        self.ended[finished.insertion_id] = finished
        self._decided, self.held_over = insertion.session.decider, insertion.held_over
        self._tried_n = insertion.tried_n + descended_n(finished.cause, finished.attempts, finished.doubts)
        while len(self.ended) > REMEMBERED_N:
            self.ended.popitem(last=False)
        self.closing = threading.Thread(  # not a daemon, as its maker is: it would be cut off at the process's end
            target=self._keep, args=([insertion], finished), name="close-recording", daemon=False
        )
        self.closing.start()

    def _keep(self, ended: list[Insertion], finished: wire.Finished) -> None:
        """Close an ended insertion's recording, inform its client, and free its memory."""
        insertion = ended.pop()
        how = finished.model_dump(mode="json", include={"outcome", "cause", "attempts", "doubts"}) | insertion.facts
        if recorder := insertion.recorder:
            recorder.close(how)
            if not recorder.kept:  # the disk took no more; a part is left for a recovery
                finished = self.ended[finished.insertion_id] = finished.model_copy(update={"recording": None})
            self.frames_unrecorded_n += recorder.left_out_n
            self._note_recorded(_lacks(recorder, recorder.problem))
        insertion.session.on_attempt = ignore  # a session that knows its insertion is freed late, and it is large
        if insertion.send:
            insertion.send(finished)
        self.hub.publish("recorded", finished)
        if recorder and not recorder.error:  # what is not recorded is no evidence
            self._learn(insertion, finished)
        self._chart({"insertion_id": finished.insertion_id, **how}, insertion.session.models)
        del insertion
        give_back()
        if problem := make_room(self.settings.recordings, self.settings.recordings_max_bytes):
            self.hub.publish("error", problem)

    def _learn(self, insertion: Insertion, finished: wire.Finished) -> None:
        """Check whether another version should now decide."""
        if self.versions is None or insertion.beside is None:
            return
        try:
            fresh, tried_n = insertion.continues is None, insertion.tried_n
            self.versions.learn(insertion.beside, finished, insertion.object, fresh=fresh, tried_n=tried_n)
        except Exception as error:  # the insertion itself has ended well
            self.hub.publish("error", f"versions: {reason(error)}")

    def _chart(self, summary: dict[str, Any], models: ModelSet) -> None:
        """Update the drift charts, which may raise an alarm; another gel or other networks restart them."""
        within = " ".join([*self._gels.values(), *(entry.sha256[:12] for entry in models.entries)])
        try:
            ended = Summary.model_validate(summary)
            if values := ended.charted:
                for chart, cause in self.charts.add(values, ended.object or "", within):
                    self.hub.publish("drift", {"chart": chart, "cause": cause.what, "remedy": cause.remedy})
                self.charts.keep()
        except (OSError, ValueError) as error:
            self.hub.publish("error", f"charts: {reason(error)}")


def _lacks(recorder: Recorder, problem: str) -> str:
    """The problem of a recording together with its name; empty without one."""
    return f"recording {recorder.path}: {problem}" if problem else ""
