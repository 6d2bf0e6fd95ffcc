"""Decide a recorded insertion again and compare bit for bit.

The recording holds every call the session got, in order, with its time. The same calls on the same frames give the
same messages; only times (latencies, ages) and the recording's path may differ.
"""

import hashlib
import json
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

from pydantic import BaseModel, ValidationError

from service.contract import FINGERS, FramePair, TactileFrame, wire
from service.contract.frames import first_error
from service.contract.shipped import released_models
from service.contract.wire import Limits
from service.decision.attempt import WorkResult
from service.decision.models import ModelSet, load_models
from service.decision.work import Work
from service.perception.rectification import Calibration
from service.recordings.names import NAME
from service.recordings.reader import Frames, Recording, RecordingError
from service.recordings.writer import FINAL
from service.session.factory import make_session
from service.session.state_machine import InsertionSession
from service.settings import Deadlines

_TIMES = {"latency_ms", "age_ms", "recording"}
_USUAL = Deadlines()
_NEEDED = {"models", "calibration", "limits", "controller", "wall_minus_monotonic_ns"}  # of the metadata


class _Given(BaseModel):
    """The service's settings that a session depends on, the usual ones where none are recorded."""

    imprint_slip: bool = True
    reference_timeout_s: float = _USUAL.reference_s
    frames_timeout_s: float = _USUAL.decision_frames_s
    decision_timeout_s: float = _USUAL.decision_s

    @classmethod
    def of(cls, recording: Recording) -> Self:
        try:
            return cls.model_validate_json(recording.settings)
        except ValidationError as error:
            raise RecordingError(f"{recording.path}: {first_error(error, 'settings')}") from None


@dataclass(slots=True)
class Replay:
    """Feeds a new session the input of a recorded one."""

    recording: Recording
    session: InsertionSession
    frames: dict[str, Frames]
    work: deque[Work] = field(default_factory=deque)
    replies: list[dict[str, Any]] = field(default_factory=list)

    def run(self) -> None:
        self.session.submit = self.work.append
        for entry in self.recording.of("/calls"):
            call = entry.json()
            replies = self._make(call, int(call["now_ns"]))
            self.replies += [r.model_dump(mode="json") for r in replies if r.type != "heartbeat"]

    def _make(self, call: dict[str, Any], now_ns: int) -> list[Any]:
        replies: list[Any] = []
        match call["call"]:
            case "message":
                replies = self.session.handle(wire.parse_client(json.dumps(call["message"])), now_ns)
            case "prime":
                self.session.prime(self._frame(call["finger"], call["seq"]))
            case "frame":
                replies = self.session.on_frame(self._frame(call["finger"], call["seq"]), now_ns)
            case "pair":
                pair = FramePair(self._frame("left", call["left"]), self._frame("right", call["right"]))
                replies = self.session.on_pair(pair, now_ns)
            case "result":
                replies = self.session.on_result(self._result(int(call["generation"])), now_ns)
            case "tick":
                replies = self.session.on_tick(now_ns)
            case "camera_fault":
                replies = self.session.on_camera_fault(call["code"], call["detail"])
        return replies

    def _frame(self, finger: str, seq: int) -> TactileFrame:
        try:
            return self.frames[finger][seq]
        except KeyError:
            raise RecordingError(f"{self.recording.path} lacks frame {seq} of the {finger} finger") from None

    def _result(self, generation: int) -> WorkResult:
        """Run pending work until it gives the result that was recorded here."""
        while self.work:
            result = self.work.popleft().run()
            if result is not None and result.generation == generation:
                return result
        raise RecordingError(f"{self.recording.path} has a result that no frames lead to")


def comparable(message: dict[str, Any]) -> dict[str, Any]:
    """A message without times and without values of this machine."""
    return {key: value for key, value in message.items() if key not in _TIMES}


def differences(recorded: list[dict[str, Any]], replayed: list[dict[str, Any]]) -> list[str]:
    """Differences of a replay, as lines; camera states in a hello are ignored."""
    differing = []
    for index in range(max(len(recorded), len(replayed))):
        then = comparable(recorded[index]) if index < len(recorded) else {"type": "nothing"}
        now = comparable(replayed[index]) if index < len(replayed) else {"type": "nothing"}
        if then["type"] == "hello" == now["type"]:
            continue
        if then != now:
            keys = [key for key in then.keys() | now.keys() if then.get(key) != now.get(key)]
            changes = "; ".join(f"{key} {then.get(key)} -> {now.get(key)}" for key in sorted(keys))
            differing.append(f"message {index} ({then['type']}): {changes}")
    return differing


def open_replay(recording: Recording, models: ModelSet) -> Replay:
    """A session like the recorded one; raise RecordingError if the models are not the recorded ones."""
    recorded = {part.rsplit(":", 1)[1] for part in recording.metadata["models"].split()}
    loaded = {entry.sha256 for entry in models.entries}
    if recorded != loaded:
        raise RecordingError(f"{recording.path} was decided by other models ({recording.metadata['models']})")
    calibration = None
    if recording.metadata["calibration"]:
        calibration = Calibration.parse(recording.metadata["calibration"].encode(), recording.path)
    limits = Limits.model_validate_json(recording.metadata["limits"])
    controller: Any = recording.metadata["controller"]
    given = _Given.of(recording)
    session = make_session(models, calibration, controller, limits, imprint=given.imprint_slip)
    session.deadlines = Deadlines(given.reference_timeout_s, given.frames_timeout_s, given.decision_timeout_s)
    session.open_gels.held_over = recording.metadata.get("held_over", "")
    return Replay(recording, session, {finger: recording.frames(finger) for finger in FINGERS})


def trusted_models(recording: Recording, folder: Path) -> ModelSet:
    """The networks that decided a recording, from a folder that the user trusts.

    A recording names networks and their paths, but it may come from anybody: no path in it is opened. A file of
    ``folder`` is used if its SHA-256 is one of the recorded ones; raises RecordingError if none of them is there.
    """
    recorded = {part.rsplit(":", 1)[1] for part in recording.metadata["models"].split() if ":" in part}
    files = {hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.glob("*.onnx")}
    if not recorded or not recorded <= files:
        where = f"they lay in {recording.metadata.get('models_folder')}; where you trust them, name it with --models"
        raise RecordingError(
            f"{recording.path} was decided by other models than those of {folder}"
            f" ({recording.metadata['models']}); {where}"
        )
    return load_models(folder)


def _before(recording: Recording) -> Path | None:
    """The recording of the insertion that this one continues; raises RecordingError if it is not beside it."""
    if not (continues := recording.metadata.get("continues")):
        return None
    here = recording.path.resolve().parent
    named = [f for f in here.parent.iterdir() if NAME.fullmatch(f.name) and f.name.partition("_")[2] == continues]
    if not (earlier := [folder / FINAL for folder in named if folder.name < here.name and (folder / FINAL).is_file()]):
        raise RecordingError(
            f"{recording.path} goes on with insertion {continues}: expected its recording beside, in {here.parent}"
        )
    return max(earlier)


def _opened(path: Path) -> Recording:
    """A recording that says what deciding it again takes; raises RecordingError."""
    recording = Recording(path)
    if missing := sorted(_NEEDED - recording.metadata.keys()):
        raise RecordingError(f"{path} lacks {', '.join(missing)} in its metadata: another version or program made it")
    return recording


def _replayed(recording: Recording, models: ModelSet) -> Replay:
    """A recording decided again; one that continues with a regrasped object needs the one before it."""
    replay = open_replay(recording, models)
    if before := _before(recording):
        decider = _replayed(_opened(before), models).session.decider
        replay.session.decider = decider and decider.afresh(recording.metadata["insertion_id"])
    replay.run()
    return replay


def redecide(path: Path, models_folder: Path | None = None) -> tuple[int, list[str]]:
    """Decide a recording again; returns the number of messages, and the differences as lines.

    Of a file that is cut off or damaged this is what can be read, and another line says so.
    """
    recording = _opened(path)
    replay = _replayed(recording, trusted_models(recording, models_folder or released_models()))
    recorded = [e.json()["message"] for e in recording.of("/messages") if e.json()["from"] == "service"]
    whole = recording.complete and not recording.recovered
    differing = differences(recorded, replay.replies if whole else replay.replies[: len(recorded)])
    if not recording.complete:
        differing.append(f"the file ends early or is damaged, behind message {len(recorded)}: {recording.damage}")
    return len(recorded), differing
