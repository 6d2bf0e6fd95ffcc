"""A running insertion's urgent and deferred work."""

import itertools
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from service.cameras.capture import CameraFrame
from service.contract import FINGERS, wire
from service.decision.models import ModelSet
from service.recordings.reader import Recording
from service.recordings.writer import Recorder
from service.session.factory import make_session
from service.session.insertion import Insertion
from tests.kept import is_as_kept
from tests.service import drawn

WRITERS = ("frame", "observation", "message", "call", "attempt")


class Witness:
    """An insertion over a real session and a real recorder, on its own clock; ``events`` logs what happened when."""

    def __init__(self, folder: Path, models: ModelSet, patch: pytest.MonkeyPatch) -> None:
        self.now_ns, self.events = 0, []
        patch.setattr("service.session.insertion.now_ns", lambda: self.now_ns)
        for name in WRITERS:
            patch.setattr(Recorder, name, self.noting(name, getattr(Recorder, name)))
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
        pair = drawn.pair(index, onset=3, slip_at=9)
        self.now_ns = pair.captured_ns
        self.insertion.frame(CameraFrame(pair.left, None), None)
        if not one_finger:
            self.insertion.frame(CameraFrame(pair.right, None), pair)

    def until_stopped(self, pairs_n: int = 10) -> None:
        """All but the last of the eleven pairs that the decision needs, or fewer; the arm stands."""
        self.insertion.message(wire.ClientHello(insertion_id="first", client="test"))
        self.insertion.message(wire.Arm(insertion_id="first", attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0))
        for index in range(pairs_n):
            self.show(index)
        stopped = wire.Stopped(insertion_id="first", attempt=1, depth_mm=6.0, outcome="blocked")
        self.insertion.message(stopped)
        self.events.clear()


@pytest.fixture
def witness(tmp_path: Path, models: ModelSet, monkeypatch: pytest.MonkeyPatch) -> Iterator[Witness]:
    made = Witness(tmp_path, models, monkeypatch)
    yield made
    made.recorder.close({})


def test_the_correction_is_sent_before_anything_is_written_or_shown_and_then_all_of_it_is(witness: Witness) -> None:
    witness.until_stopped()
    witness.show(10)
    first, *rest = witness.events
    assert first == "send correction"
    assert rest.count("write frame") == rest.count("write observation") == 2
    assert rest.count("write attempt") == rest.count("message") == 1
    assert rest.index("message") < rest.index("write message")


def test_an_end_is_written_down_before_it_is_published_and_the_recording_is_whole(witness: Witness) -> None:
    witness.until_stopped()
    witness.show(10)
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
    witness.show(10)
    witness.insertion.continues = "before"
    facts = witness.insertion.facts
    del facts["seconds"]
    is_as_kept(__file__, "summary", facts)


def test_the_thread_lets_go_for_a_moment_after_an_answer_and_never_else(
    witness: Witness, monkeypatch: pytest.MonkeyPatch
) -> None:
    slept_s: list[float] = []
    monkeypatch.setattr("service.session.insertion.time.sleep", slept_s.append)
    witness.insertion.frame(CameraFrame(drawn.pair(0).left, None), None)
    assert slept_s == []
    witness.until_stopped()
    slept_s.clear()
    witness.show(10)
    assert [0.0 < pause_s < 0.002 for pause_s in slept_s] == [True]
    witness.now_ns += 10**9
    witness.insertion.tick()
    assert len(slept_s) == 1


def test_what_waits_for_an_answer_waits_a_tenth_of_a_second_at_most(witness: Witness) -> None:
    witness.until_stopped(2)
    witness.show(2, one_finger=True)
    shown_ns, sent_ns = witness.now_ns, witness.now_ns + 7_000_000_000
    began_ns = witness.insertion._settled_ns
    for after_ms, written in ((20, False), (90, False), (110, True)):
        witness.now_ns = began_ns + after_ms * 1_000_000
        samples = (sample(sent_ns), sample(sent_ns + 1), sample(sent_ns + 2))
        witness.insertion.message(wire.Telemetry(insertion_id="first", sent_ns=sent_ns, samples=samples, left_out_n=0))
        witness.insertion.tick()
        assert bool(witness.events) == written, after_ms
    assert shown_ns > began_ns


def test_a_pair_that_is_not_the_last_one_is_written_down_at_once_though_the_arm_stands(witness: Witness) -> None:
    witness.until_stopped(2)
    witness.show(2)
    assert witness.events.count("write frame") == 2


def test_watchers_see_the_newest_place_of_the_robot_and_clients_are_answered_first(witness: Witness) -> None:
    heard: list[Any] = []
    witness.insertion.publish = lambda kind, content: heard.append((kind, content))
    samples = tuple(sample(at_ns) for at_ns in (10, 20, 30))
    witness.insertion.message(wire.Telemetry(insertion_id="first", sent_ns=30, samples=samples))
    witness.insertion.message(wire.Telemetry(insertion_id="first", sent_ns=30, samples=()))
    assert heard == [("robot", samples[-1])]


def test_every_frame_is_recorded_once_from_the_first_on_whichever_way_it_came(witness: Witness) -> None:
    """The right finger's frames come alone and again as half of a pair, the left one's as half of a pair only."""
    witness.insertion.prime(CameraFrame(drawn.pair(0).right, None))
    for index in range(3):
        pair = drawn.pair(index)
        witness.insertion.frame(CameraFrame(pair.right, None), pair)
    path = witness.recorder.close({})
    topics = {finger: [entry.seq for entry in Recording(path).of(f"/{finger}/image_raw")] for finger in FINGERS}
    assert topics == {"left": [0, 1, 2], "right": [0, 1, 2]}


def test_a_dropped_frame_whose_partner_comes_after_the_next_one_is_recorded_too(witness: Witness) -> None:
    """Of a busy machine: the left finger's frame 1 was dropped from the queue, and its pair comes after frame 2."""
    pairs = [drawn.pair(index) for index in range(3)]
    witness.insertion.message(wire.ClientHello(insertion_id="first", client="test"))
    witness.insertion.message(wire.Arm(insertion_id="first", attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0))
    witness.insertion.frame(CameraFrame(pairs[0].right, None), pairs[0])
    witness.insertion.frame(CameraFrame(pairs[2].left, None), None)
    witness.insertion.frame(CameraFrame(pairs[1].right, None), pairs[1])
    recording = Recording(witness.recorder.close({}))
    called = [call["left"] for entry in recording.of("/calls") if (call := entry.json())["call"] == "pair"]
    assert called == [0, 1]
    assert set(called) <= set(recording.frames("left"))


def test_a_stop_is_as_old_as_its_frame_is_when_it_is_sent_and_not_when_it_was_found(witness: Witness) -> None:
    frame_ns, sent_ns = 5_000_000_000, 5_012_500_000
    slip = wire.Slip(
        insertion_id="first",
        attempt=1,
        finger="left",
        frame_seq=1,
        captured_ns=frame_ns,
        age_ms=4.0,
        score=8.0,
        reason="",
    )
    enough = wire.Enough(insertion_id="first", attempt=1, frame_seq=1, captured_ns=frame_ns, pressed_mm=0.8)
    heard: list[Any] = []
    published: list[tuple[str, Any]] = []
    witness.insertion.send, witness.now_ns = heard.append, sent_ns
    witness.insertion.publish = lambda *event: published.append(event)
    witness.insertion._emit([slip, enough, wire.OpenLearnt(insertion_id="first")], sent_ns)
    assert [heard[0].age_ms, *heard[1:]] == [12.5, enough, wire.OpenLearnt(insertion_id="first")]
    witness.now_ns += 100_000_000
    witness.insertion._settle()
    assert [content for kind, content in published if kind == "stop_age_s"] == [0.0125, 0.0125]


def test_an_insertion_without_a_client_or_a_recorder_goes_on_all_the_same(witness: Witness) -> None:
    witness.insertion.send = witness.insertion.recorder = None
    witness.until_stopped()
    witness.show(10)
    assert witness.insertion.session.attempt is not None
    assert witness.insertion.session.attempt.decision is not None
    assert not [event for event in witness.events if event.startswith(("send", "write"))]
    assert witness.insertion.facts["decisions"][0]["type"] == "correction"


def test_the_summary_holds_hundredths_of_a_second_and_no_object_that_was_not_named(witness: Witness) -> None:
    witness.insertion.opened_ns, witness.now_ns = 2_000_000_000, 3_234_567_890
    facts = witness.insertion.facts
    assert (facts["seconds"], facts["robot_samples_lost_n"], facts.get("object")) == (1.23, 0, None)
    assert "continues" not in facts


def test_a_heartbeat_is_answered_and_neither_recorded_nor_shown(witness: Witness) -> None:
    witness.until_stopped(1)
    witness.insertion.message(wire.ClientHeartbeat(insertion_id="first", count=3))
    assert witness.events == ["send heartbeat"]


def test_the_calls_that_a_replay_needs_are_recorded_and_ticks_without_an_answer_are_not(witness: Witness) -> None:
    witness.until_stopped(2)
    witness.insertion.camera_fault("camera_lost", "left is gone")
    witness.now_ns += 100_000_000
    witness.insertion.tick()
    witness.now_ns += 100_000_000_000
    witness.insertion.tick()
    calls = [entry.json()["call"] for entry in Recording(witness.recorder.close({})).of("/calls")]
    assert calls[-2:] == ["camera_fault", "tick"]
    assert set(calls) == {"message", "frame", "pair", "camera_fault", "tick"}


def test_other_versions_answer_beside_the_active_one_once_it_is_decided(witness: Witness) -> None:
    witness.insertion.beside = SimpleNamespace(active="a", decide=lambda attempt: {"b": attempt.arm.attempt})  # type: ignore[assignment]
    witness.until_stopped()
    witness.show(10)
    witness.recorder.close({})
    assert witness.insertion.facts["decisions"][0]["beside"] == {"b": 1}
