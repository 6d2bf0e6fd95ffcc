"""What a client says twice, too early or of another attempt; and what outlives an attempt."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from service.contract import Finger, FramePair, TactileFrame, wire
from service.perception.observation import Observation
from service.session.state_machine import InsertionSession
from tests.service import tiny_models
from tests.service.decision.test_claim import PERIOD_NS, observation

ID = "test-1"
S = 10**9
PIXELS = np.zeros((2, 2, 3), np.uint8)


class Still:
    """A finger that sees an object at rest in every frame."""

    gel_distance = None

    def __init__(self, finger: Finger) -> None:
        self.sees = observation(finger)

    def rearm(self) -> None:
        """What it sees is its reference already."""

    def learn_open(self, _: TactileFrame) -> str:
        return ""

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
