"""Open gels are learnt between attempts, from the first frames that show them."""

from pathlib import Path
from typing import Any

import pytest
from websockets.sync.client import connect

from service.contract import TactileFrame, wire
from service.decision.held_tilt import HeldTilt
from service.session.state_machine import InsertionSession
from tests.service.client import greeted
from tests.service.conftest import LiveService, live_service
from tests.service.decision.test_claim import PERIOD_NS
from tests.service.session.at_rest import ID, PIXELS, S, arm, at_rest, descends, is_out_of_order, shows, stops
from tests.service.session.driving import wait_for_recorders


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


@pytest.mark.parametrize("refused_until_ns", [0, S + 1, 3 * S])
def test_a_finger_of_which_nothing_is_shown_is_named_and_no_gel(
    session: InsertionSession, refused_until_ns: int
) -> None:
    """However the other's is: what its client advises against a strange gel opens the fingers."""
    learn(session, S)
    for at_ns in range(S, 3 * S, PERIOD_NS):
        session.left.problem = "no markers" if at_ns < refused_until_ns else ""
        assert session.on_frame(TactileFrame("left", 0, at_ns, PIXELS), at_ns) == []
    (fault,) = session.on_tick(3 * S + 1)
    assert (fault.code, fault.fatal) == ("camera_stalled", False)
    assert fault.detail == "the open gels could not be learnt: no frame of the right finger arrived"


@pytest.mark.parametrize("after", ["nothing", "a decided attempt"])
@pytest.mark.parametrize("code", ["camera_lost", "internal"])
def test_a_camera_or_a_service_that_fails_while_open_gels_are_learnt_is_named_at_once(
    session: InsertionSession, after: str, code: wire.FaultCode
) -> None:
    """Two seconds later, all that would be known is that no frame has arrived."""
    if after == "a decided attempt":
        arm(session)
        shows(session, 0)
        stops(session, at_ns=PERIOD_NS)
        session.on_tick(4 * S)
    assert session.on_camera_fault(code, "left is gone") == []
    learn(session, 5 * S)
    (fault,) = session.on_camera_fault(code, "left is gone")
    assert (fault.code, fault.fatal, fault.detail) == (code, False, "left is gone")
    assert session.attempt is None or not session.attempt.broken
    assert [answer.type for answer in shows(session, 0, 5 * S)] == ["open_learnt"], "it came back in time"
    assert session.on_camera_fault(code, "left is gone") == []


def test_a_gel_that_is_refused_is_tried_once_a_frame_and_its_cause_is_sought_at_the_end(
    session: InsertionSession,
) -> None:
    """Both take up to a tenth of a second, in which no message is answered."""
    right = session.right
    learn(session, S)
    right.problem, right.cause = "not the gel", "the cameras are swapped"
    for seq in range(3):
        session.on_frame(TactileFrame("right", seq, S + seq * PERIOD_NS, PIXELS), S + seq * PERIOD_NS)
        shows(session, seq, S)
    assert (right.tried, right.explained) == ([0, 1, 2], [])
    (fault,) = session.on_tick(3 * S + 1)
    assert fault.detail == "the open gels could not be learnt: right finger: not the gel: the cameras are swapped"
    assert right.explained == [2]
    learn(session, 4 * S)
    shows(session, 0, S)
    (fault,) = session.on_tick(7 * S)
    assert fault.detail == "the open gels could not be learnt: no frame of the left and right finger arrived"


def test_what_turned_out_not_to_be_an_open_gel_is_forgotten_without_an_answer(session: InsertionSession) -> None:
    learn(session, S)
    assert [answer.type for answer in shows(session, 0, S)] == ["open_learnt"]
    assert session.left.learnt
    assert session.handle(wire.LearnOpen(insertion_id=ID, forget=True), S) == []
    assert (session.left.learnt, session.right.learnt) == ([], [])
    assert not session.wants_frames
    assert session.on_tick(100 * S) == []


@pytest.mark.parametrize(("attempt", "pressed"), [(1, False), (2, True)])
def test_an_attempt_that_only_armed_leaves_what_the_ones_before_it_pressed(
    session: InsertionSession, attempt: int, *, pressed: bool
) -> None:
    """The second attempt of an insertion follows one that went down."""
    arm(session)
    assert session.attempt is not None
    session.attempt.arm = session.attempt.arm.model_copy(update={"attempt": attempt})
    assert bool(session.open_gels.after(session.attempt)) == pressed


@pytest.mark.parametrize("forget", [False, True])
def test_an_object_that_is_grasped_anew_between_attempts_is_not_tilted_as_it_was(
    session: InsertionSession, *, forget: bool
) -> None:
    """The tool would tilt an upright object. A hand that was not open after all still holds it as it did."""
    session.most_tilt_deg = 1.5
    arm(session, gripper_width_mm=50.0)
    shows(session, 0)
    stops(session, at_ns=3 * S)
    session.on_tick(6 * S)
    assert session.decider is not None
    session.decider.grasp.tilt = HeldTilt()
    session.decider.grasp.tilt.turned(1.0, 0.0, 0.0)
    learn(session, 7 * S)
    assert [answer.type for answer in shows(session, 0, 7 * S)] == ["open_learnt"]
    if forget:
        session.handle(wire.LearnOpen(insertion_id=ID, forget=True), 7 * S)
    arm(session, 2, 8 * S, gripper_width_mm=48.0)
    assert [answer.type for answer in shows(session, 0, 8 * S)] == ["straighten" if forget else "armed"]
    assert session.decider.grasp.width_mm == (50.0 if forget else 48.0)
    assert session.decider.grasp.tried, "its neighbours have been pressed all the same"


def test_an_attempt_that_went_down_and_is_armed_again_leaves_what_it_pressed(session: InsertionSession) -> None:
    """The object is refused; who starts the next insertion with it still in the hand is refused, too."""
    learn(session, 0)
    shows(session, 0)
    arm(session)
    shows(session, 0)
    descends(session)
    arm(session, at_ns=S)
    assert [answer.type for answer in shows(session, 0, S)] == ["refused"]
    session.handle(wire.Abort(insertion_id=ID, cause="refused", reason="turned in the hand"), S)
    assert session.open_gels.after(session.attempt)


@pytest.mark.parametrize(
    ("before", "detail"),
    [("", "started anew"), ("pressed", "do not show"), ("inserted", "do not show"), ("restarted", "started anew")],
)
def test_a_service_knows_how_an_object_hangs_only_if_it_has_seen_the_hand_open(
    tmp_path: Path, models_folder: Path, before: str, detail: str
) -> None:
    """A confirmed object may stay in the hand, too; and no recording tells what an earlier service has not recorded."""
    with live_service(tmp_path, models_folder) as live:
        if before:
            driver = greeted(live, "before")
            ended = driver.attempt(1) if before == "pressed" else driver.insert(1)
            assert ended.type == ("correction" if before == "pressed" else "finished")
            driver.close()
            wait_for_recorders()
        answers = [] if before == "restarted" else arms_at_once(live)
    if before == "restarted":
        with live_service(tmp_path, models_folder) as live:
            answers = arms_at_once(live)
    assert [answer.type for answer in answers] == ["hello", "refused"]
    assert answers[1].reason == "turned_in_hand"
    assert detail in answers[1].detail


def arms_at_once(live: LiveService) -> list[Any]:
    """The answers to a client that arms with the hand as it is."""
    with connect(live.url("/v1/insertion", "ws"), additional_headers=live.bearer, compression=None) as link:
        link.send(wire.ClientHello(insertion_id="again", client="test").model_dump_json())
        arm = wire.Arm(insertion_id="again", attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0)
        link.send(arm.model_dump_json())
        return [wire.parse_service(link.recv(60)) for _ in range(2)]
