"""A running insertion's urgent and deferred work."""

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from service.cameras.capture import CameraFrame
from service.contract import wire
from service.decision.models import load_models
from service.recordings.reader import Recording
from service.recordings.writer import Recorder
from service.session.factory import make_session
from service.session.insertion import Insertion
from tests.kept import is_as_kept
from tests.service import drawn, tiny_models

WRITERS = ("frame", "observation", "message", "call", "attempt")


class Witness:
    """An insertion over a real session and a real recorder, on its own clock; ``events`` logs what happened when."""

    def __init__(self, folder: Path, patch: pytest.MonkeyPatch) -> None:
        self.now_ns, self.events = 0, []
        patch.setattr("service.session.insertion.now_ns", lambda: self.now_ns)
        for name in WRITERS:
            patch.setattr(Recorder, name, self.noting(name, getattr(Recorder, name)))
        models = load_models(tiny_models.write_models(folder / "models"))
        self.recorder = Recorder(folder / "recordings", "first", {}, 1 << 30)
        session = make_session(models, drawn.calibration())
        self.insertion = Insertion(session, self.recorder, self.send, lambda kind, _: self.events.append(kind))

    def noting(self, name: str, write: Any) -> Any:
        def noted(*given: Any) -> None:
            self.events.append(f"write {name}")
            write(*given)

        return noted

    def send(self, message: wire.ServiceMessage) -> None:
        self.events.append(f"send {message.type}")

    def show(self, index: int, *, one_finger: bool = False) -> None:
        pair = drawn.pair(index)
        self.now_ns = pair.captured_ns
        self.insertion.frame(CameraFrame(pair.left, None), None)
        if not one_finger:
            self.insertion.frame(CameraFrame(pair.right, None), pair)

    def until_stopped(self) -> None:
        """All but the last pair that the decision needs; the arm stands."""
        self.insertion.message(wire.ClientHello(insertion_id="first", client="test"))
        self.insertion.message(wire.Arm(insertion_id="first", attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0))
        for index in range(17):
            self.show(index)
        stopped = wire.Stopped(insertion_id="first", attempt=1, depth_mm=6.0, outcome="blocked")
        self.insertion.message(stopped)
        self.events.clear()


@pytest.fixture
def witness(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Witness]:
    made = Witness(tmp_path, monkeypatch)
    yield made
    made.recorder.close({})


def test_the_correction_is_sent_before_anything_is_written_or_shown_and_then_all_of_it_is(witness: Witness) -> None:
    witness.until_stopped()
    witness.show(17)
    first, *rest = witness.events
    assert first == "send correction"
    assert rest.count("write frame") == rest.count("write observation") == 2
    assert rest.count("write attempt") == rest.count("message") == 1
    assert rest.index("message") < rest.index("write message")


def test_what_waits_for_an_answer_that_does_not_come_is_written_down_all_the_same(witness: Witness) -> None:
    witness.until_stopped()
    witness.show(17, one_finger=True)
    assert not witness.events
    witness.now_ns += 200_000_000
    witness.insertion.tick()
    assert witness.events.count("write frame") == 1


def test_an_end_is_written_down_before_it_is_published_and_the_recording_is_whole(witness: Witness) -> None:
    witness.until_stopped()
    witness.show(17)
    witness.insertion.message(wire.Abort(insertion_id="first", cause="operator", reason="done"))
    assert witness.events[-2:] == ["message", "finished"]
    path = witness.recorder.close({})
    kinds = [entry.json()["message"]["type"] for entry in Recording(path).of("/messages")]
    assert kinds[-2:] == ["abort", "finished"]
    assert (path.parent / "attempt_01.npz").exists()
    assert isinstance(witness.insertion.session.finished, wire.Finished)


def test_an_end_that_is_asked_for_again_is_told_again(witness: Witness) -> None:
    witness.insertion.message(wire.ClientHello(insertion_id="first", client="test"))
    abort = wire.Abort(insertion_id="first", cause="operator", reason="done")
    for _ in range(2):
        witness.insertion.message(abort)
    assert witness.events.count("finished") == 2
    witness.insertion.message(wire.ClientHeartbeat(insertion_id="first", count=1))
    assert witness.events[-1] == "send heartbeat"


def sample(at_ns: int) -> wire.RobotSample:
    return wire.RobotSample(at_ns=at_ns, phase="descending", attempt=1)


def test_where_the_robot_was_is_recorded_on_this_machines_clock_by_its_fastest_message(witness: Witness) -> None:
    """The client's clock is 7 s ahead; its messages took 5, 1 and 3 ms."""
    witness.insertion.message(wire.ClientHello(insertion_id="first", client="test"))
    for number, took_ms in enumerate((5, 1, 3)):
        at_ns = 1_000_000_000 * (number + 1)
        witness.now_ns = at_ns + took_ms * 1_000_000
        sent_ns = at_ns + 7_000_000_000
        witness.insertion.message(
            wire.Telemetry(insertion_id="first", sent_ns=sent_ns, samples=(sample(sent_ns),), left_out_n=number)
        )
    assert witness.events.count("robot") == 3
    witness.insertion.opened_ns = 0
    assert witness.insertion.facts["robot_samples_lost_n"] == 3
    assert witness.insertion.facts["seconds"] == 3.0
    path = witness.recorder.close({})
    stamps_ns = [entry.log_ns for entry in Recording(path).of("/robot")]
    assert [round((b - a) / 1e6) for a, b in itertools.pairwise(stamps_ns)] == [996, 1000]


def test_the_summary_says_what_was_decided_in_which_object_and_by_which_start(witness: Witness) -> None:
    pose = wire.ToolPose(x_mm=8.0, y_mm=0.0, z_mm=35.0, yaw_deg=6.0)
    witness.insertion.message(wire.ClientHello(insertion_id="first", client="test"))
    witness.insertion.message(wire.Episode(insertion_id="first", object="box", start=pose, approach=pose))
    witness.until_stopped()
    witness.show(17)
    witness.insertion.continues = "before"
    facts = witness.insertion.facts
    del facts["seconds"]
    is_as_kept(__file__, "summary", facts)
