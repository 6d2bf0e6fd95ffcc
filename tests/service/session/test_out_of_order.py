"""What a client says twice, too early or of another attempt, and what outlives an attempt."""

from dataclasses import replace

import pytest

from service.contract import TactileFrame, wire
from service.contract.shipped import released_models
from service.decision.attempt import WorkResult
from service.decision.evidence import Refusal
from service.decision.models import load_models
from service.decision.work import Work
from service.session.state_machine import InsertionSession
from tests.service.decision.test_claim import PERIOD_NS
from tests.service.session.at_rest import ID, PIXELS, S, arm, at_rest, descends, is_out_of_order, shows, stops
from tests.service.session.test_decider import EVIDENCE


@pytest.fixture
def session() -> InsertionSession:
    return at_rest()


def test_a_motion_is_taken_only_of_the_attempt_that_is_armed(session: InsertionSession) -> None:
    arm(session)
    assert is_out_of_order(descends(session)), "before its reference was taken"
    assert is_out_of_order(stops(session))
    assert [answer.type for answer in shows(session, 0)] == ["armed"]
    assert is_out_of_order(descends(session, attempt=2))
    assert is_out_of_order(stops(session, attempt=2, outcome="inserted"))
    assert is_out_of_order(stops(session, attempt=2, outcome="dropped"))
    assert session.attempt is not None
    assert (session.attempt.descending_ns, session.attempt.stopped_ns, session.attempt.outcome) == (None, None, None)
    assert descends(session, at_ns=5) == stops(session, at_ns=7) == []
    assert is_out_of_order(descends(session, at_ns=9)), "the arm stands"
    assert (session.attempt.descending_ns, session.attempt.stopped_ns) == (5, 7)


def test_slip_is_watched_from_the_reference_to_the_stop(session: InsertionSession) -> None:
    watches = [session.watches_slip]
    for step in (arm, lambda one: shows(one, 0), descends, stops):
        step(session)
        watches.append(session.watches_slip)
    assert watches == [False, False, True, True, False]


def test_a_stop_that_is_told_again_does_not_let_its_decision_come_later(session: InsertionSession) -> None:
    arm(session)
    shows(session, 0)
    stops(session)
    assert stops(session, at_ns=S) == []
    assert session.on_tick(2 * S) == []
    (refused,) = stops(session, at_ns=2 * S + 1)
    assert (refused.type, refused.reason) == ("no_decision", "no_motion")


def test_a_blocked_attempt_does_not_become_one_at_full_depth(session: InsertionSession) -> None:
    """Where the arm goes after it has stopped, nobody watches it."""
    arm(session)
    shows(session, 0)
    descends(session)
    for index in range(1, 10):
        shows(session, index)
    stops(session, at_ns=9 * PERIOD_NS)
    assert stops(session, at_ns=9 * PERIOD_NS + 1, outcome="inserted", depth_mm=25.0) == []
    assert [answer.type for answer in session.on_tick(4 * S)] == ["no_decision"]


def test_a_speed_that_is_told_on_the_way_begins_a_leg_and_no_new_descent(session: InsertionSession) -> None:
    arm(session)
    shows(session, 0)
    descends(session, at_ns=3)
    leg = wire.Descending(insertion_id=ID, attempt=1, speed_mm_s=5.0, start_mm=2.0)
    assert session.handle(leg, 8) == []
    assert session.attempt is not None
    under_way = session.attempt
    assert (under_way.descending_ns, under_way.leg_ns, under_way.speed_mm_s, under_way.start_mm) == (3, 8, 5.0, 2.0)


@pytest.mark.parametrize(
    ("then_mm", "now_mm", "doubted"), [(50.0, 50.0, False), (40.0, 40.0, True), (40.0, 50.0, False)]
)
def test_the_width_at_the_first_arming_is_what_full_depth_is_compared_with(
    session: InsertionSession, then_mm: float, now_mm: float, doubted: bool
) -> None:
    """Of a grasp that gave way in the first attempt, the width at the second one shows nothing."""
    arm(session, gripper_width_mm=50.0)
    assert [answer.type for answer in session.on_tick(3 * S)] == ["refused"]
    arm(session, 2, 3 * S, gripper_width_mm=then_mm)
    for index in range(2):
        shows(session, index, 3 * S)
    (end,) = stops(session, 2, 3 * S + PERIOD_NS, outcome="inserted", depth_mm=25.0, gripper_width_mm=now_mm)
    assert end.outcome == "not_confirmed"
    assert ("width" in [doubt.reason for doubt in end.doubts]) == doubted


def test_nothing_moves_any_more_once_the_last_attempt_is_decided(session: InsertionSession) -> None:
    for attempt in range(1, wire.MAX_ATTEMPTS + 1):
        at_ns = attempt * 10 * S
        assert arm(session, attempt, at_ns) == []
        if attempt < wire.MAX_ATTEMPTS:
            assert session.on_tick(at_ns + 2 * S) == []
            (refused,) = session.on_tick(at_ns + 2 * S + 1)
            assert (refused.type, refused.reason) == ("refused", "no_reference")
    shows(session, 0, at_ns)
    session.on_camera_fault("camera_lost", "left gone")
    undecided, finished = stops(session, wire.MAX_ATTEMPTS, at_ns)
    assert (undecided.type, finished.type) == ("no_decision", "finished")
    assert (finished.outcome, finished.cause, finished.attempts) == ("failed", "attempts", wire.MAX_ATTEMPTS)
    assert not session.wants_frames
    assert shows(session, 1, at_ns) == session.on_tick(at_ns + 10 * S) == []
    assert session.on_camera_fault("camera_lost", "left gone") == []
    assert arm(session, 1, at_ns) == descends(session) == [finished]


def test_a_failing_camera_ends_no_arming_and_disturbs_nobody_between_attempts(session: InsertionSession) -> None:
    assert session.on_camera_fault("camera_stalled", "left stands still") == []
    arm(session)
    (fault,) = session.on_camera_fault("camera_stalled", "left stands still")
    assert (fault.code, fault.fatal) == ("camera_stalled", False)
    assert [answer.type for answer in shows(session, 0)] == ["armed"]
    assert session.attempt is not None
    assert not session.attempt.spoilt, "its reference was taken later"


def test_slip_is_told_once_and_an_attempt_that_went_down_is_not_armed_again(session: InsertionSession) -> None:
    """Who arms it again has not told where the arm stopped: how far that turned the object is not known."""
    arm(session)
    shows(session, 0)
    descends(session)
    still, session.left.sees = session.left.sees, replace(session.left.sees)
    session.left.slips()
    (slip,) = shows(session, 1)
    assert (slip.type, slip.finger, slip.frame_seq) == ("slip", "left", 1)
    assert shows(session, 2) == []
    session.left.sees = still
    assert arm(session, at_ns=S) == [], "what was armed is of another time"
    (refused,) = shows(session, 0, S)
    assert (refused.type, refused.reason) == ("refused", "turned_in_hand")


def test_an_attempt_that_did_not_go_down_is_armed_again_with_a_new_reference_after_a_slip(
    session: InsertionSession,
) -> None:
    arm(session)
    shows(session, 0)
    still, session.left.sees = session.left.sees, replace(session.left.sees)
    session.left.slips()
    assert [answer.type for answer in shows(session, 1)] == ["slip"]
    session.left.sees = still
    assert arm(session, at_ns=S) == [], "what was armed is of another time"
    (armed,) = shows(session, 0, S)
    assert (armed.type, armed.frame_captured_ns) == ("armed", S)


def test_a_late_result_of_another_insertion_is_no_evidence_here(session: InsertionSession) -> None:
    arm(session)
    shows(session, 0)
    assert session.on_result(WorkResult("another", 1, EVIDENCE, None, {}), 0) == []
    assert session.attempt is not None
    assert session.attempt.result is None


def test_what_the_networks_say_late_of_a_motion_before_the_descent_is_no_answer_to_the_press() -> None:
    """The object sags just before the arm goes down: that is dismissed, while the networks still work on it."""
    session, works = at_rest(), list[Work]()
    session.models, session.submit = load_models(released_models()), works.append
    arm(session)
    shows(session, 0)
    session.left.sees = replace(session.left.sees, onset_ns=PERIOD_NS)
    shows(session, 1)
    descends(session, at_ns=PERIOD_NS + 1)
    (sag,) = [result for work in works if (result := work.run())]
    assert sag.refusal is not None
    assert session.on_result(sag, PERIOD_NS + 2) == []
    assert session.attempt is not None
    assert (session.attempt.result, session.attempt.fed) == (None, False)


def test_full_depth_is_claimed_by_a_pair_that_is_new_enough_and_by_that_alone(session: InsertionSession) -> None:
    """At 10 mm/s; when the client is sure of the stop, the newest pair is 0.55 s old."""
    arm(session)
    for index in range(76):
        shows(session, index)
        if index == 0:
            descends(session)
    now_ns = 75 * PERIOD_NS + 550_000_000
    assert stops(session, at_ns=now_ns, depth_mm=25.0, outcome="inserted", still_s=0.54) == []
    assert session.on_tick(now_ns) == []
    (end,) = shows(session, 0, now_ns)
    assert (end.outcome, end.cause, end.attempts, end.doubts) == ("inserted", None, 1, ())
    assert stops(session, depth_mm=3.0) == [end]


def test_of_two_results_the_first_one_is_kept(session: InsertionSession) -> None:
    arm(session)
    shows(session, 0)
    results = [WorkResult(ID, 1, None, Refusal("low_confidence", str(number)), {}) for number in range(2)]
    assert [session.on_result(result, 0) for result in results] == [[], []], "the arm still moves"
    (refused,) = stops(session)
    assert (refused.reason, refused.detail) == ("low_confidence", "0")


def test_frames_between_attempts_are_not_judged(session: InsertionSession) -> None:
    observed = list[int]()
    session.on_observation = lambda observation: observed.append(observation.seq)
    arm(session)
    (refused,) = session.on_tick(3 * S)
    assert refused.detail == "no frame pair arrived"
    shows(session, 0, 3 * S)
    session.on_frame(TactileFrame("left", 1, 4 * S, PIXELS), 4 * S)
    session.on_frame(TactileFrame("right", 1, 4 * S, PIXELS), 4 * S)
    assert observed == []


def test_why_a_reference_cannot_be_taken_is_told(session: InsertionSession) -> None:
    unread = replace(session.right.sees.field, status="no_grid", reason="too dark")
    session.right.sees = replace(session.right.sees, field=unread)
    arm(session)
    assert shows(session, 0) == shows(session, 1) == []
    (refused,) = session.on_tick(3 * S)
    assert (refused.reason, refused.detail) == ("no_reference", "right: too dark")


def test_who_missed_a_refusal_and_arms_again_gets_the_same_one(session: InsertionSession) -> None:
    arm(session)
    (refused,) = session.on_tick(3 * S)
    assert arm(session, at_ns=4 * S) == [refused]
    assert not session.wants_frames, "it begins nothing"
    assert is_out_of_order(arm(session, 3, 4 * S))
    assert arm(session, 2, 4 * S) == [], "the next one has the next number"
    assert is_out_of_order(arm(session, 1, 4 * S))


def test_a_correction_is_commanded_once_and_a_refusal_never(session: InsertionSession) -> None:
    commanded = list[float]()
    session.on_command = lambda command: commanded.append(command.dx_mm)
    arm(session)
    shows(session, 0)
    assert session.attempt is not None
    session.attempt.decision_pairs = [*session.attempt.ring]
    session.on_result(WorkResult(ID, 1, EVIDENCE, None, {}), 0)
    assert commanded == [], "the arm still moves"
    (correction,) = stops(session)
    assert stops(session) == [correction]
    assert commanded == [correction.dx_mm]
    arm(session, 2, S)
    session.on_tick(4 * S)
    assert len(commanded) == 1


def test_an_abort_for_frames_that_came_unjudged_tells_why_they_were_not(session: InsertionSession) -> None:
    arm(session)
    shows(session, 0)
    descends(session)
    copy = replace(session.right.sees.field, status="duplicate", reason="the frame repeats an earlier one")
    session.right.sees = replace(session.right.sees, field=copy)
    shows(session, 1)
    (finished,) = session.handle(wire.Abort(insertion_id=ID, cause="unwatched", reason="the lease ended"), S)
    assert (finished.outcome, finished.cause) == ("failed", "unwatched")
    assert [doubt.detail for doubt in finished.doubts] == [
        "the newest frame of the right finger was not judged: the frame repeats an earlier one"
    ]


def test_an_abort_for_frames_that_did_not_come_has_no_more_to_tell(session: InsertionSession) -> None:
    arm(session)
    shows(session, 0)
    descends(session)
    (finished,) = session.handle(wire.Abort(insertion_id=ID, cause="unwatched", reason="the lease ended"), S)
    assert finished.doubts == ()
