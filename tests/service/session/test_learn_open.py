"""Open gels are learnt between attempts, from the first frames that show them."""

from typing import Any

import pytest

from service.contract import wire
from service.session.state_machine import InsertionSession
from tests.service.decision.test_claim import PERIOD_NS
from tests.service.session.at_rest import ID, S, arm, at_rest, is_out_of_order, shows, stops


@pytest.fixture
def session() -> InsertionSession:
    return at_rest()


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
    assert session.on_tick(3 * S) == []
    (fault,) = session.on_tick(3 * S + 1)
    assert (fault.code, fault.fatal) == ("open_gel", False)
    assert fault.detail == "the open gels could not be learnt: left finger: no markers"
    assert shows(session, 0, 4 * S) == []
    session.left.problem = ""
    learn(session, 5 * S)
    assert [answer.type for answer in shows(session, 0, 5 * S)] == ["open_learnt"]


def test_what_turned_out_not_to_be_an_open_gel_is_forgotten_without_an_answer(session: InsertionSession) -> None:
    learn(session, S)
    assert [answer.type for answer in shows(session, 0, S)] == ["open_learnt"]
    assert session.left.learnt
    assert session.handle(wire.LearnOpen(insertion_id=ID, forget=True), S) == []
    assert (session.left.learnt, session.right.learnt) == ([], [])
    assert not session.wants_frames
    assert session.on_tick(100 * S) == []
