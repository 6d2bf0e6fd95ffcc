from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from service.contract import wire
from service.decision.models import ModelSet
from service.session.factory import make_session
from service.session.state_machine import InsertionSession
from tests.service import drawn

ID = "test-1"


@pytest.fixture
def session(models: ModelSet) -> InsertionSession:
    return make_session(models, drawn.calibration())


def hello(session: InsertionSession, **changes: object) -> wire.ServiceHello:
    (reply,) = session.handle(wire.ClientHello(insertion_id=ID, client="test", **changes), 0)
    assert isinstance(reply, wire.ServiceHello)
    return reply


def probe(session: InsertionSession, attempt: int, start_ns: int, frames: int = 30, outcome: str = "blocked") -> list:
    """One attempt in lock step at 6 mm/s: the arm stops one frame after slip, or at the last frame."""
    messages = session.handle(
        wire.Arm(insertion_id=ID, attempt=attempt, gap_width_mm=56.0, expected_depth_mm=25.0), start_ns
    )
    stopped = False
    for index in range(frames):
        pair = drawn.pair(index, start_ns=start_ns)
        messages += session.on_pair(pair, pair.captured_ns)
        if index == 1:
            messages += session.handle(wire.Descending(insertion_id=ID, attempt=attempt), pair.captured_ns)
        if not stopped and (any(isinstance(m, wire.Slip) for m in messages) or index == frames - 1):
            stopped = True
            message = wire.Stopped(insertion_id=ID, attempt=attempt, depth_mm=3.0, outcome=outcome)
            messages += session.handle(message, pair.captured_ns)
    return messages


def kinds(messages: list) -> list[str]:
    return [message.type for message in messages if message.type != "watching"]


def test_a_blocked_attempt_arms_slips_and_is_corrected(session: InsertionSession) -> None:
    hello(session)
    messages = probe(session, 1, 0)
    assert kinds(messages) == ["armed", "slip", "correction"]
    armed, slip, correction = (message for message in messages if message.type != "watching")
    assert armed.reference_seq == 0
    assert 16 <= slip.frame_seq <= 18
    assert correction.attempt == 1
    assert sum(correction.class_probabilities.values()) == pytest.approx(1)
    assert set(correction.latency_ms) >= {"rectify", "markers", "slip", "networks_last_step", "controller"}
    assert 0.0 <= correction.latency_ms["since_last_frame"] <= 3 * drawn.PERIOD_NS / 1e6


def goes_in(session: InsertionSession, attempt: int, **stated: Any) -> wire.Finished:
    """An attempt that meets nothing."""
    arm = wire.Arm(insertion_id=ID, attempt=attempt, gap_width_mm=56.0, expected_depth_mm=25.0, **stated)
    session.handle(arm, 5 * 10**10)
    for index in range(8):
        pair = drawn.pair(index, start_ns=5 * 10**10)
        session.on_pair(pair, pair.captured_ns)
        if index == 1:
            session.handle(wire.Descending(insertion_id=ID, attempt=attempt), pair.captured_ns)
    end = wire.Stopped(insertion_id=ID, attempt=attempt, depth_mm=25.0, outcome="inserted")
    (finished,) = session.handle(end, pair.captured_ns)
    return finished


def test_an_insertion_of_several_attempts_ends_with_inserted_where_the_neighbours_stay(
    session: InsertionSession,
) -> None:
    hello(session, controller="heuristic")
    for attempt in (1, 2, 3):
        assert kinds(probe(session, attempt, attempt * 10**10))[-1] == "correction"
    finished = goes_in(session, 4, neighbours_stay=True)
    assert (finished.outcome, finished.attempts) == ("inserted", 4)


def test_attempts_of_a_probe_are_decided_apart_with_one_knowledge_of_the_grasp(models: ModelSet) -> None:
    """Its next error does not follow from the last correction; how the object hangs follows from all presses."""
    moves, grasps = dict[str, list[tuple[float, float]]](), []
    for purpose in ("probe", "insert"):
        session = make_session(models, drawn.calibration())
        hello(session, purpose=purpose)
        decided = [probe(session, attempt, attempt * 10**10)[-1] for attempt in (1, 2, 3)]
        moves[purpose] = [(one.dx_mm, one.dtheta_deg) for one in decided]
        assert session.decider is not None
        grasps.append(session.decider.grasp.blocked_pitch)
    assert len(set(moves["probe"])) == 1
    assert moves["insert"][0] == moves["probe"][0]
    assert len(set(moves["insert"])) == 3
    assert grasps[0] == grasps[1] > 0.0


def test_where_neighbours_may_be_pushed_aside_nothing_is_inserted_after_a_press(models: ModelSet) -> None:
    for before, continues, reasons in ((0, None, []), (1, None, ["neighbours"]), (0, "earlier", ["neighbours"])):
        session = make_session(models, drawn.calibration())
        hello(session, continues=continues)
        for attempt in range(1, before + 1):
            probe(session, attempt, attempt * 10**10)
        finished = goes_in(session, before + 1)
        assert [doubt.reason for doubt in finished.doubts] == reasons
        assert finished.outcome == ("not_confirmed" if reasons else "inserted")


def test_the_arm_came_to_stand_before_its_client_was_sure_of_it(session: InsertionSession) -> None:
    hello(session)
    session.handle(wire.Arm(insertion_id=ID, attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0), 0)
    for index in range(3):
        session.on_pair(drawn.pair(index), drawn.pair(index).captured_ns)
    session.handle(wire.Descending(insertion_id=ID, attempt=1), 10**9)
    stopped = wire.Stopped(insertion_id=ID, attempt=1, depth_mm=5.0, outcome="blocked", still_s=0.15)
    session.handle(stopped, 2 * 10**9)
    assert session.attempt is not None
    assert session.attempt.stopped_ns == 1_850_000_000


@pytest.mark.parametrize(("decided", "refused"), [(False, (2, 3)), (True, (1, 3))])
def test_only_the_attempt_after_a_decided_one_is_armed(
    session: InsertionSession, decided: bool, refused: tuple[int, int]
) -> None:
    hello(session)
    probe(session, 1, 0) if decided else armed_with(session, 0)
    first = session.attempt
    arm = wire.Arm(insertion_id=ID, attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0)
    for attempt in refused:
        assert kinds(session.handle(arm.model_copy(update={"attempt": attempt}), 10**10)) == ["fault"]
    assert session.attempt is first
    if not decided:
        assert kinds(session.handle(arm, 10**10)) == ["armed"], "a repeated arm is answered again"
        assert session.attempt is first


def armed_with(session: InsertionSession, index: int) -> list:
    arm = wire.Arm(insertion_id=ID, attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0)
    pair = drawn.pair(index, onset=100, slip_at=100)
    return [*session.handle(arm, pair.captured_ns), *session.on_pair(pair, pair.captured_ns)]


@pytest.mark.parametrize("blind", ["left", "right"])
def test_one_blind_finger_in_a_descent_is_as_stale_as_two(session: InsertionSession, blind: str) -> None:
    hello(session)
    armed_with(session, 0)
    messages = []
    for index in range(1, 20):
        pair = drawn.pair(index, onset=100, slip_at=100)
        frame = pair.right if blind == "left" else pair.left
        messages += session.on_frame(frame, frame.captured_ns) + session.on_tick(frame.captured_ns)
    assert [message.code for message in messages] == ["stale_frames"]


def test_a_first_frame_that_cannot_be_read_is_no_reference_and_the_next_one_is(session: InsertionSession) -> None:
    hello(session)
    arm = wire.Arm(insertion_id=ID, attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0)
    session.handle(arm, drawn.pair(0).captured_ns)
    dark = replace(drawn.pair(0).right, pixels=np.zeros_like(drawn.pair(0).right.pixels))
    assert session.on_frame(dark, dark.captured_ns) == [], "the left camera dropped its frame, so there is no pair"
    answers = [answer for k in (1, 2) for answer in session.on_pair(drawn.pair(k), drawn.pair(k).captured_ns)]
    assert [answer.type for answer in answers] == ["armed", "watching"], "both fingers watch from the next pair on"


def test_after_a_cameras_fault_the_same_attempt_is_armed_with_a_new_reference_only(session: InsertionSession) -> None:
    hello(session)
    armed_with(session, 0)
    session.on_camera_fault("camera_lost", "left gone")
    again = drawn.pair(1).captured_ns
    arm = wire.Arm(insertion_id=ID, attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0)
    assert session.handle(arm, again) == [], "the old reference is of another time"
    (armed,) = session.on_pair(drawn.pair(1), again)
    assert armed.reference_seq == 1
    assert session.attempt is not None
    assert session.attempt.broken == ""


def test_frames_that_are_stale_again_after_a_new_arm_are_a_fault_again(session: InsertionSession) -> None:
    hello(session)
    armed_with(session, 0)
    assert kinds(session.on_tick(600_000_000)) == ["fault"]
    assert kinds(armed_with(session, 21)) == ["armed"]
    assert kinds(session.on_tick(1_400_000_000)) == ["fault"]


@pytest.mark.parametrize(("outcome", "late"), [("blocked", True), ("stopped", False)])
def test_a_press_whose_depth_is_not_known_is_answered_with_no_move(
    session: InsertionSession, outcome: str, late: bool
) -> None:
    """Its frames grew too old before the last ones came, or the arm stopped of itself while others still came."""
    hello(session)
    arm = wire.Arm(insertion_id=ID, attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0)
    messages = session.handle(arm, 0)
    for index in range(30):
        pair = drawn.pair(index)
        messages += session.on_pair(pair, pair.captured_ns)
        if index == 1:
            messages += session.handle(wire.Descending(insertion_id=ID, attempt=1), pair.captured_ns)
        if index == 14 and late:
            messages += session.on_tick(pair.captured_ns + 600_000_000)
    stopped = wire.Stopped(insertion_id=ID, attempt=1, depth_mm=3.0, outcome=outcome)
    messages += session.handle(stopped, pair.captured_ns)
    assert kinds(messages) == ["armed", *["fault"] * late, "slip", "no_decision"]
    assert messages[-1].reason == "stale"


def test_open_gels_that_no_new_frame_shows_are_a_fault_once_and_not_before_their_time(
    session: InsertionSession,
) -> None:
    hello(session)
    asked_ns, wait_ns = 5_000_000_000, round(session.deadlines.reference_s * 1e9)
    session.handle(wire.LearnOpen(insertion_id=ID), asked_ns)
    old = drawn.pair(0, start_ns=asked_ns - 1)
    assert session.on_pair(old, asked_ns) == [], "what was captured before the hand was open shows nothing"
    assert session.on_tick(asked_ns + wait_ns) == []
    (fault,) = session.on_tick(asked_ns + wait_ns + 1)
    why = "the open gels could not be learnt: no frame of the left and right finger arrived"
    assert (fault.code, fault.detail) == ("camera_stalled", why), "no gel and no forgotten part is to blame"
    assert session.on_tick(asked_ns + 2 * wait_ns) == []


def test_the_result_of_an_earlier_arming_or_after_the_end_changes_nothing(session: InsertionSession) -> None:
    hello(session)
    probe(session, 1, 0)
    late = session.attempt.result
    session.handle(wire.Arm(insertion_id=ID, attempt=2, gap_width_mm=56.0, expected_depth_mm=25.0), 10**10)
    assert session.on_result(late, 10**10) == []
    assert session.attempt.result is None
    session.handle(wire.Abort(insertion_id=ID, cause="operator", reason="test"), 10**10)
    assert session.on_result(replace(late, generation=session.attempt.generation), 10**10) == []
    assert session.attempt.result is None
