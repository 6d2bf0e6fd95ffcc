"""What a client says twice, too early or of another attempt, and what outlives an attempt; on made-up fingers."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from service.contract import Finger, FramePair, TactileFrame, wire
from service.decision.attempt import WorkResult
from service.decision.evidence import Refusal
from service.perception.observation import Observation
from service.session.state_machine import InsertionSession
from tests.service import tiny_models
from tests.service.decision.test_claim import PERIOD_NS, observation

ID = "test-1"
S = 10**9
PIXELS = np.zeros((2, 2, 3), np.uint8)


class Still:
    """A finger that sees an object at rest in every frame, until a test changes what it ``sees``."""

    gel_distance = None

    def __init__(self, finger: Finger) -> None:
        self.sees, self.problem, self.learnt = observation(finger), "", list[int]()

    def rearm(self) -> None:
        """What it sees is its reference already."""

    def learn_open(self, frame: TactileFrame) -> str:
        self.learnt += [] if self.problem else [frame.seq]
        return self.problem

    def slips(self) -> None:
        slip = replace(self.sees.slip, state="gross_slip", score=1.0)
        self.sees = replace(self.sees, slip=slip)

    def observe(self, frame: TactileFrame) -> Observation:
        return replace(self.sees, seq=frame.seq, captured_ns=frame.captured_ns)


@pytest.fixture
def session() -> InsertionSession:
    models: Any = SimpleNamespace(card=tiny_models.card("direction", "step"), entries=())
    session = InsertionSession(models, Still("left"), Still("right"))
    session.handle(wire.ClientHello(insertion_id=ID, client="test"), 0)
    return session


def arm(session: InsertionSession, attempt: int = 1, at_ns: int = 0, **stated: Any) -> list[Any]:
    usual = {"gap_width_mm": 56.0, "expected_depth_mm": 25.0}
    return session.handle(wire.Arm(insertion_id=ID, attempt=attempt, **usual | stated), at_ns)


def shows(session: InsertionSession, index: int, from_ns: int = 0) -> list[Any]:
    at_ns = from_ns + index * PERIOD_NS
    pair = FramePair(*(TactileFrame(finger, index, at_ns, PIXELS) for finger in ("left", "right")))
    return [answer for answer in session.on_pair(pair, at_ns) if answer.type != "watching"]


def descends(session: InsertionSession, attempt: int = 1, at_ns: int = 0) -> list[Any]:
    return session.handle(wire.Descending(insertion_id=ID, attempt=attempt, speed_mm_s=10.0), at_ns)


def stops(session: InsertionSession, attempt: int = 1, at_ns: int = 0, **told: Any) -> list[Any]:
    usual = {"depth_mm": 3.0, "outcome": "blocked"}
    return session.handle(wire.Stopped(insertion_id=ID, attempt=attempt, **usual | told), at_ns)


def is_out_of_order(answers: list[Any]) -> bool:
    (fault,) = answers
    return (fault.type, fault.code, fault.fatal) == ("fault", "protocol", False)


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


def test_a_speed_that_is_told_on_the_way_begins_a_leg_and_no_new_descent(session: InsertionSession) -> None:
    arm(session)
    shows(session, 0)
    descends(session, at_ns=3)
    leg = wire.Descending(insertion_id=ID, attempt=1, speed_mm_s=5.0, start_mm=2.0)
    assert session.handle(leg, 8) == []
    assert session.attempt is not None
    told = session.attempt
    assert (told.descending_ns, told.leg_ns, told.speed_mm_s, told.start_mm) == (3, 8, 5.0, 2.0)


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


def test_who_says_hello_again_changes_nothing(session: InsertionSession) -> None:
    again = wire.ClientHello(insertion_id=ID, client="test", controller="heuristic", takes_afresh=True)
    (hello,) = session.handle(again, 5)
    assert hello.controller == "belief"
    assert not session.takes_afresh


def test_slip_is_told_once_and_the_same_attempt_is_armed_with_a_new_reference_only(session: InsertionSession) -> None:
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
    (armed,) = shows(session, 0, S)
    assert (armed.type, armed.frame_captured_ns) == ("armed", S)
    session.left.slips()
    assert [answer.type for answer in shows(session, 1, S)] == ["slip"]


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
    results = [WorkResult(1, 1, None, Refusal("low_confidence", str(number)), {}) for number in range(2)]
    assert [session.on_result(result, 0) for result in results] == [[], []], "the arm still moves"
    (refused,) = stops(session)
    assert (refused.reason, refused.detail) == ("low_confidence", "0")


def learn(session: InsertionSession, at_ns: int) -> list[Any]:
    return session.handle(wire.LearnOpen(insertion_id=ID), at_ns)


def test_open_gels_are_not_learnt_in_an_attempt_which_would_then_not_be_watched(session: InsertionSession) -> None:
    arm(session)
    (fault,) = learn(session, 0)
    assert (fault.code, fault.fatal, fault.detail) == ("protocol", False, "learn_open while an attempt is under way")
    assert [answer.type for answer in shows(session, 0)] == ["armed"]
    assert is_out_of_order(learn(session, 0))
    session.right.slips()
    assert [answer.type for answer in shows(session, 1)] == ["slip"]
    stops(session, at_ns=PERIOD_NS)
    assert is_out_of_order(learn(session, PERIOD_NS))
    assert [answer.type for answer in session.on_tick(4 * S)] == ["no_decision"]
    assert learn(session, 4 * S) == []
    assert [answer.type for answer in shows(session, 0, 4 * S)] == ["open_learnt"]


def test_open_gels_are_learnt_once_from_the_first_frames_that_show_them(session: InsertionSession) -> None:
    left, right = session.left, session.right
    learn(session, S)
    right.problem = "no markers"
    assert shows(session, -1, S) == shows(session, 0, S) == shows(session, 1, S) == []
    right.problem = ""
    assert [answer.type for answer in shows(session, 2, S)] == ["open_learnt"]
    assert (left.learnt, right.learnt) == ([0], [2])
    assert shows(session, 3, S) == session.on_tick(100 * S) == []
    assert not session.wants_frames


def test_why_open_gels_could_not_be_learnt_is_told_and_they_may_be_asked_for_again(session: InsertionSession) -> None:
    learn(session, S)
    session.left.problem = "no markers"
    shows(session, 0, S)
    (fault,) = session.on_tick(3 * S + 1)
    assert (fault.code, fault.detail) == ("open_gel", "the open gels could not be learnt: left finger: no markers")
    assert shows(session, 0, 4 * S) == []
    session.left.problem = ""
    learn(session, 5 * S)
    assert [answer.type for answer in shows(session, 0, 5 * S)] == ["open_learnt"]
