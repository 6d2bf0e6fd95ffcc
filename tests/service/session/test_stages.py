"""What a session takes in which stage of an attempt, and how an attempt and an insertion end."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from service.contract import wire
from service.decision.attempt import Stage, WorkResult
from service.decision.held_tilt import HeldTilt
from service.decision.models import ModelSet, load_models
from service.session.factory import make_session
from service.session.state_machine import InsertionSession
from tests.service import drawn

ID = "stages"
S = 10**9


@pytest.fixture(scope="module")
def models(models_folder: Any) -> ModelSet:
    return load_models(models_folder)


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


def test_slip_is_watched_from_the_arming_to_the_order_to_stop(session: InsertionSession) -> None:
    assert (session.watches_slip, session.wants_frames) == (False, False)
    session.handle(arm(), 0)
    assert (session.watches_slip, session.wants_frames) == (False, True)
    session.on_pair(drawn.pair(0), 0)
    assert session.attempt is not None
    assert session.watches_slip
    session.attempt.stops(1)
    assert (session.watches_slip, session.wants_frames) == (False, True)
    session.handle(stopped(), 2)
    assert (session.watches_slip, session.wants_frames) == (False, True)
    session.handle(wire.Abort(insertion_id=ID, cause="operator", reason="done"), 3)
    assert not session.wants_frames


def test_open_gels_are_waited_for_before_an_attempt_and_not_after_the_end(session: InsertionSession) -> None:
    session.handle(wire.LearnOpen(insertion_id=ID), 0)
    assert (session.watches_slip, session.wants_frames) == (False, True)
    session.handle(wire.Abort(insertion_id=ID, cause="operator", reason="done"), 0)
    assert not session.wants_frames


def test_the_width_of_a_grasp_is_that_of_its_first_arming(session: InsertionSession) -> None:
    armed(session, gripper_width_mm=50.0)
    session.on_camera_fault("camera_lost", "left is gone")
    session.handle(stopped(), 0)
    session.handle(arm(2, gripper_width_mm=47.0), S)
    assert session.decider is not None
    assert session.decider.grasp.width_mm == 50.0


def test_no_attempt_follows_the_last_one_that_is_allowed(session: InsertionSession) -> None:
    armed(session)
    for number, kinds in ((wire.MAX_ATTEMPTS - 1, ["no_decision"]), (wire.MAX_ATTEMPTS, ["no_decision", "finished"])):
        assert session.attempt is not None
        session.attempt = replace(
            session.attempt, arm=arm(number), stage=Stage.ARMED, broken="left is gone", decision=None
        )
        replies = session.handle(stopped(number), number * S)
        assert [reply.type for reply in replies] == kinds
    assert (replies[-1].outcome, replies[-1].cause, replies[-1].attempts) == ("failed", "attempts", wire.MAX_ATTEMPTS)


def test_an_insertion_that_ends_before_any_attempt_had_none(session: InsertionSession) -> None:
    session.recording = "r/one"
    (ended,) = session.handle(wire.Abort(insertion_id=ID, cause="link", reason="gone"), 0)
    assert (ended.outcome, ended.cause, ended.attempts, ended.recording) == ("failed", "link", 0, "r/one")
    for message in (arm(), stopped(), wire.LearnOpen(insertion_id=ID)):
        assert session.handle(message, 1) == [ended]
    assert session.on_tick(10**12) == []


def test_without_a_reference_an_arming_is_refused_when_its_time_is_over_and_says_what_was_wrong(
    session: InsertionSession,
) -> None:
    for attempt, problem in ((1, ""), (1, "left: no markers")):
        session.handle(arm(attempt), 5 * S)
        assert session.attempt is not None
        session.attempt.problem = problem
        assert session.on_tick(7 * S) == []
        (refused,) = session.on_tick(7 * S + 1)
        assert (refused.reason, refused.detail) == ("no_reference", problem or "no frame pair arrived")
        session.attempt = None
    armed(session)
    assert [reply.type for reply in session.on_tick(9 * S)] == ["fault"], "the frames are old, and nothing is refused"


def test_an_attempt_that_is_not_armed_neither_descends_nor_stops(session: InsertionSession) -> None:
    descending = wire.Descending(insertion_id=ID, attempt=1)
    session.handle(arm(), 0)
    for message in (descending, stopped()):
        (fault,) = session.handle(message, 0)
        assert (fault.code, fault.fatal, fault.insertion_id) == ("protocol", False, ID)
    session.on_pair(drawn.pair(0), 0)
    for message in (wire.Descending(insertion_id=ID, attempt=2), stopped(2)):
        (fault,) = session.handle(message, 0)
        assert "attempt 2" in fault.detail
    assert session.handle(descending, 7) == []
    assert session.attempt is not None
    assert (session.attempt.descending_ns, session.attempt.outcome) == (7, None)


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


def test_who_arms_too_early_is_told_how_the_attempt_before_stands(session: InsertionSession) -> None:
    armed(session)
    (fault,) = session.handle(arm(2), 0)
    assert fault.detail == "arm of attempt 2, but attempt 1 is not decided yet"
    session.on_camera_fault("camera_lost", "left is gone")
    session.handle(stopped(), 0)
    (fault,) = session.handle(arm(3), 0)
    assert fault.detail == "arm of attempt 3, but attempt 1 is decided"


def test_a_camera_that_fails_between_attempts_or_before_the_reference_spoils_none(session: InsertionSession) -> None:
    assert session.on_camera_fault("camera_lost", "left is gone") == []
    session.handle(arm(), 0)
    assert [fault.code for fault in session.on_camera_fault("camera_lost", "left is gone")] == ["camera_lost"]
    assert session.attempt is not None
    assert session.attempt.broken == ""


def test_the_first_answer_of_the_networks_counts_and_its_move_is_shown_once(session: InsertionSession) -> None:
    moves: list[Any] = []
    ended: list[Any] = []
    session.on_command, session.on_attempt = moves.append, ended.append
    armed(session)
    assert session.attempt is not None
    first, second = (WorkResult(ID, 1, None, None, {}) for _ in range(2))
    assert session.on_result(first, 0) == session.on_result(second, 0) == [], "the arm still moves"
    assert session.attempt.result is first
    (answer,) = session.handle(stopped(), 0)
    assert (answer.type, answer.reason, moves, len(ended)) == ("no_decision", "non_finite", [], 1)
    move: Any = object()
    session.decider = SimpleNamespace(conclude=lambda *_: None, command=move)  # type: ignore[assignment]
    session._conclude(0)
    assert moves == [move]


@pytest.mark.parametrize(
    ("doubts", "afresh", "ends"),
    [
        (None, True, []),
        ((), False, [("inserted", None)]),
        ((wire.Doubt(reason="push", detail="pushed"),), True, [("not_confirmed", "not_confirmed")]),
        ((wire.Doubt(reason="moved_in_hand", detail="turned"),), True, [("aborted", "afresh")]),
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
    assert asked == [(session.attempt, 5, 500.0)]
    assert session.attempt is not None
    assert session.attempt.gripper_width_mm == 49.0


def blocked_and_turned(session: InsertionSession, deg: float) -> None:
    """An attempt has ended without a decision, and is known to have turned the object."""
    armed(session)
    session.on_camera_fault("camera_lost", "left is gone")
    session.handle(stopped(), S)
    assert session.decider is not None
    session.decider.grasp.tilt = HeldTilt()
    session.decider.grasp.tilt.turned(deg)


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
    assert fault.detail == "arm of attempt 3, but attempt 2 is not decided yet"
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
