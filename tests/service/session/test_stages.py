"""What a session takes in which stage of an attempt, and how an attempt and an insertion end."""

from types import SimpleNamespace
from typing import Any

import pytest

from service.contract import wire
from service.decision.held_tilt import HeldTilt
from service.decision.models import ModelSet
from service.session.factory import make_session
from service.session.state_machine import InsertionSession
from tests.service import drawn

ID = "stages"
S = 10**9


@pytest.fixture
def session(models: ModelSet) -> InsertionSession:
    """Greeted."""
    made = make_session(models, drawn.calibration())
    made.handle(wire.ClientHello(insertion_id=ID, client="test"), 0)
    return made


def arm(attempt: int = 1, **changes: Any) -> wire.Arm:
    return wire.Arm(insertion_id=ID, attempt=attempt, gap_width_mm=56.0, expected_depth_mm=25.0, **changes)


def stopped(attempt: int = 1, outcome: Any = "blocked", **changes: Any) -> wire.Stopped:
    return wire.Stopped(insertion_id=ID, attempt=attempt, depth_mm=6.0, outcome=outcome, **changes)


def armed(session: InsertionSession, attempt: int = 1, at_ns: int = 0, **changes: Any) -> None:
    session.handle(arm(attempt, **changes), at_ns)
    (answer,) = session.on_pair(drawn.pair(0, start_ns=at_ns), at_ns)
    assert answer.type == "armed"


def test_an_insertion_that_ends_before_any_attempt_had_none(session: InsertionSession) -> None:
    session.recording = "r/one"
    (ended,) = session.handle(wire.Abort(insertion_id=ID, cause="link", reason="gone"), 0)
    assert (ended.outcome, ended.cause, ended.attempts, ended.recording) == ("failed", "link", 0, "r/one")
    for message in (arm(), stopped(), wire.LearnOpen(insertion_id=ID)):
        assert session.handle(message, 1) == [ended]
    assert session.on_tick(10**12) == []


def test_a_message_before_the_greeting_is_answered_by_its_own_name_and_a_strange_one_by_ours(models: ModelSet) -> None:
    session = make_session(models, drawn.calibration())
    (fault,) = session.handle(arm(), 0)
    assert (fault.insertion_id, fault.detail) == (ID, "arm before hello")
    session.handle(wire.ClientHello(insertion_id=ID, client="test", controller="heuristic", takes_afresh=True), 0)
    (fault,) = session.handle(wire.ClientHeartbeat(insertion_id="other", count=1), 0)
    assert (fault.insertion_id, fault.detail) == (ID, f"insertion id other, expected {ID}")
    again = session.handle(wire.ClientHello(insertion_id=ID, client="test", controller="belief"), 0)
    assert again[0].controller == session.controller_name == "heuristic", "the first greeting counts"
    assert session.takes_afresh


def test_who_arms_too_early_is_told_which_attempt_is_expected_and_why(session: InsertionSession) -> None:
    (fault,) = session.handle(arm(2), 0)
    assert fault.detail == "arm of attempt 2, expected 1: none has begun"
    armed(session)
    (fault,) = session.handle(arm(2), 0)
    assert fault.detail == "arm of attempt 2, expected 1: attempt 1 is not decided yet"
    session.on_camera_fault("camera_lost", "left is gone")
    session.handle(stopped(), 0)
    (fault,) = session.handle(arm(3), 0)
    assert fault.detail == "arm of attempt 3, expected 2: attempt 1 is decided"


@pytest.mark.parametrize(
    ("doubts", "afresh", "ends"),
    [
        (None, True, []),
        ((), False, [("inserted", None)]),
        ((wire.Doubt(reason="push", detail="pushed"),), True, [("not_confirmed", "not_confirmed")]),
        ((wire.Doubt(reason="moved_in_hand", detail="turned"),), True, [("regrasped", "afresh")]),
        ((wire.Doubt(reason="moved_in_hand", detail="turned"),), False, [("not_confirmed", "not_confirmed")]),
    ],
)
def test_full_depth_ends_an_insertion_by_what_is_doubted_of_it(
    session: InsertionSession, doubts: Any, afresh: bool, ends: list[Any]
) -> None:
    asked: list[Any] = []
    armed(session)
    session.takes_afresh = afresh
    session.decider = SimpleNamespace(doubts=lambda *given: asked.append(given) or doubts)  # type: ignore[assignment]
    replies = session.handle(stopped(outcome="inserted", gripper_width_mm=49.0), 5)
    assert [(reply.outcome, reply.cause) for reply in replies] == ends
    assert [reply.doubts for reply in replies] == [doubts] * len(ends)
    assert asked == [(session.attempt, 5)]
    assert session.attempt is not None
    assert session.attempt.gripper_width_mm == 49.0


def blocked_and_turned(session: InsertionSession, deg: float) -> None:
    """An attempt has ended without a decision, and is known to have turned the object."""
    armed(session)
    session.on_camera_fault("camera_lost", "left is gone")
    session.handle(stopped(), S)
    assert session.decider is not None
    session.decider.grasp.tilt = HeldTilt()
    session.decider.grasp.tilt.turned(deg, 0.0, 0.0)


def test_a_client_that_may_tilt_its_tool_is_asked_to_and_arms_the_same_attempt_again(models: ModelSet) -> None:
    session = make_session(models, drawn.calibration())
    session.handle(wire.ClientHello(insertion_id=ID, client="test", most_tilt_deg=1.5), 0)
    blocked_and_turned(session, 0.7)
    session.handle(arm(2), 2 * S)
    (asked,) = session.on_pair(drawn.pair(1, start_ns=2 * S), 2 * S)
    assert (asked.type, asked.attempt) == ("straighten", 2)
    assert asked.tilt_deg == pytest.approx(-0.7)
    assert not session.wants_frames, "the arm moves freely"
    assert session.on_pair(drawn.pair(2, start_ns=2 * S), 2 * S) == []
    assert session.on_tick(60 * S) == [], "and takes its time"
    (fault,) = session.handle(wire.Descending(insertion_id=ID, attempt=2, speed_mm_s=5.0), 60 * S)
    assert "not armed" in fault.detail
    (fault,) = session.handle(arm(3), 60 * S)
    assert fault.detail == "arm of attempt 3, expected 2: attempt 2 is not decided yet"
    session.handle(arm(2, tilt_deg=asked.tilt_deg), 61 * S)
    (answer,) = session.on_pair(drawn.pair(3, start_ns=61 * S), 61 * S)
    assert (answer.type, answer.attempt) == ("armed", 2)


def test_a_tool_that_did_not_tilt_as_asked_is_asked_again_and_a_client_that_may_not_is_refused(
    session: InsertionSession, models: ModelSet
) -> None:
    blocked_and_turned(session, 1.0)
    session.handle(arm(2), 2 * S)
    (refused,) = session.on_pair(drawn.pair(1, start_ns=2 * S), 2 * S)
    assert (refused.type, refused.reason) == ("refused", "turned_in_hand")
    tilting = make_session(models, drawn.calibration())
    tilting.handle(wire.ClientHello(insertion_id=ID, client="test", most_tilt_deg=1.5), 0)
    blocked_and_turned(tilting, 0.7)
    for number, (tilt_deg, kind) in enumerate(((0.0, "straighten"), (0.5, "straighten"), (-0.7, "armed")), 1):
        tilting.handle(arm(2, tilt_deg=tilt_deg), 2 * S)
        (answer,) = tilting.on_pair(drawn.pair(number, start_ns=2 * S), 2 * S)
        assert answer.type == kind
