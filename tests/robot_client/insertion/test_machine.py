"""The insertion's state machine: the story it must tell."""

import math

import pytest

from robot_client.insertion.events import (
    Begin,
    Failure,
    Grasped,
    Hold,
    Move,
    PartLost,
    Send,
    Standstill,
    Tick,
    Width,
)
from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.machine import Phase, State, step
from service.contract import wire
from tests.robot_client.insertion.stories import (
    APPROACH,
    ID,
    PLAN,
    TO_ARMING,
    TO_CLOSING,
    TO_DECISION,
    TO_DESCENT,
    TO_STOP,
    armed,
    at,
    correction,
    held,
    hello,
    no_decision,
    run,
    service,
    slip,
)


def test_a_blocked_attempt_is_reported_corrected_in_the_air_and_tried_again():
    state, commands = run(TO_DECISION)
    assert state.phase is Phase.DECIDING
    sent = [c.message for c in commands if isinstance(c, Send)]
    assert [m.type for m in sent] == ["hello", "arm", "descending", "stopped"]
    assert (sent[-1].depth_mm, sent[-1].outcome) == (7.0, "blocked")
    state, (retract,) = step(state, service(correction(1)))
    assert (retract.motion, retract.target) == ("retract", APPROACH), "up along the vertical it came down"
    state, (travel,) = step(state, at(APPROACH))
    assert (travel.motion, travel.target) == ("travel", APPROACH.corrected(-3.0, -2.0))
    state, (arm,) = step(state, at(APPROACH.corrected(-3.0, -2.0)))
    assert (state.phase, arm.message.attempt) == (Phase.ARMING, 2)


def test_an_open_hand_shows_its_gels_before_it_closes():
    state, commands = run([Begin(at_s=0.0, pose=APPROACH), service(hello())])
    assert (state.phase, commands[-1].message.type) == (Phase.LEARNING, "learn_open")
    state, (grasp,) = step(state, service(wire.OpenLearnt(insertion_id=ID)))
    assert (state.phase, grasp.kind) == (Phase.GRASPING, "grasp")


@pytest.mark.parametrize(("stood_s", "stated_s"), [(0.15, 0.15), (2.5, 1.0)])
def test_the_gripper_s_width_and_since_when_the_arm_stands_go_with_the_messages_that_need_them(stood_s, stated_s):
    still = Standstill(at_s=0.0, pose=APPROACH.at_height(28.0), still_s=stood_s)
    _, commands = run([*TO_STOP, Width(at_s=0.0, width_mm=31.5), still])
    widths = {
        c.message.type: c.message.gripper_width_mm
        for c in commands
        if hasattr(c, "message") and hasattr(c.message, "gripper_width_mm")
    }
    assert widths == {"arm": 50.0, "stopped": 31.5}
    assert next(c.message.still_s for c in commands if isinstance(c, Send) and c.message.type == "stopped") == stated_s


@pytest.mark.parametrize("attempts_n", [1, 3])
def test_an_object_that_turned_on_its_way_in_is_taken_afresh_while_attempts_are_left(attempts_n):
    limits = PLAN.limits.model_copy(update={"max_attempts": attempts_n})
    plan = PLAN.model_copy(update={"fixture": True, "limits": limits})
    doubt = wire.Doubt(reason="moved_in_hand", detail="the gels show it turned")
    ended = wire.Finished(insertion_id=ID, outcome="regrasped", attempts=1, cause="afresh", doubts=(doubt,))
    state, commands = run([*TO_CLOSING, service(ended)], State(plan))
    assert (state.phase, state.tried_n) == (Phase.FAILED, 1)
    assert [c.message.takes_afresh for c in commands if isinstance(c, Send) and c.message.type == "hello"] == [True]
    again = state.afresh("second")
    assert commands[-1].message.cause == ("not_confirmed" if again is None else "afresh")
    assert (again and again.limits.max_attempts) == (None if attempts_n == 1 else 2)


def test_a_full_descent_is_an_insertion():
    state, _ = run(TO_CLOSING)
    assert state.phase is Phase.CLOSING
    state, commands = step(state, service(wire.Finished(insertion_id=ID, outcome="inserted", attempts=1)))
    assert (state.phase, commands) == (Phase.INSERTED, ())


@pytest.mark.parametrize(
    "stands",
    [
        APPROACH.at_height(0.01),  # in metres
        APPROACH.at_height(8.9),
        APPROACH.at_height(36.1),
        APPROACH.at_height(10.0).corrected(1.1, 0.0),
        APPROACH.at_height(10.0).corrected(0.0, 1.1),
    ],
)
def test_a_pose_off_the_descent_is_no_depth_that_anybody_is_told(stands):
    state, commands = run([*TO_DESCENT, at(APPROACH.at_height(10.0)), at(stands, Standstill)])
    assert state.phase is Phase.FAILED
    assert state.reason.startswith("arm: tracking: the arm stands")
    assert [c.message.type for c in commands if isinstance(c, Send)][-2:] == ["descending", "abort"]
    assert commands[-2].stop, "the controller's program ends, too"


@pytest.mark.parametrize(
    "event",
    [
        service(wire.Finished(insertion_id=ID, outcome="not_confirmed", attempts=1)),
        service(wire.Finished(insertion_id=ID, outcome="failed", attempts=1)),
        Failure(at_s=0.0, source="service", code="link", detail="connection lost"),
        Failure(at_s=0.0, source="service", code="silent", detail="no message"),
        Tick(at_s=30.1),
    ],
    ids=["not confirmed", "failed", "link lost", "silent", "no answer"],
)
def test_full_depth_alone_is_no_claim(event):
    state, _ = run(TO_CLOSING)
    assert state.phase is Phase.CLOSING
    state, commands = step(state, event)
    reason = held(state, commands)
    assert "not claimed" in reason or isinstance(getattr(event, "message", None), wire.Finished | wire.Fault)


def test_the_approach_goes_up_over_and_down():
    low = WorkPose(x_mm=-5.0, y_mm=2.0, z_mm=20.0, yaw_deg=0.0)
    state, commands = run([Begin(at_s=0.0, pose=low, held=True), service(hello()), Grasped(at_s=0.0, width_mm=50.0)])
    path = [commands[-1].target, *state.path]
    assert path == [low.at_height(35.0), APPROACH, APPROACH]
    _, onwards = step(state, at(low.at_height(35.0)))
    assert [commands[-1].motion, onwards[-1].motion] == ["retract", "travel"], "slowly from between the blocks"


@pytest.mark.parametrize(
    ("held", "x_mm", "lifted_mm"),
    [(False, -20.0, 85.0), (True, -20.0, 85.0), (False, 8.1, 85.0), (True, 8.1, 45.0), (True, 8.6, 85.0)],
)
def test_an_object_is_lifted_out_of_its_fixture_before_it_goes_over(held, x_mm, lifted_mm):
    """A gripper that knows of a part from before, as after a stop in the fixture, does not know where that was."""
    pick = WorkPose(x_mm=x_mm, y_mm=0.1, z_mm=45.0, yaw_deg=0.0)
    plan = PLAN.model_copy(update={"over_mm": 85.0})
    learnt = [] if held else [service(wire.OpenLearnt(insertion_id=ID))]
    begun = [Begin(at_s=0.0, pose=pick, held=held), service(hello()), *learnt, Grasped(at_s=0.0, width_mm=50.0)]
    state, commands = run(begun, State(plan))
    path = [commands[-1].target, *state.path]
    assert path == [pick.at_height(lifted_mm), APPROACH.at_height(lifted_mm), APPROACH]


def test_an_insertion_begins_at_a_fixture_on_the_edge_of_the_box_where_no_arm_stands_exactly():
    edge = WorkPose(x_mm=-40.02, y_mm=20.03, z_mm=45.0, yaw_deg=45.01)
    state, commands = run([Begin(at_s=0.0, pose=edge, held=True), service(hello()), Grasped(at_s=0.0, width_mm=50.0)])
    assert (state.phase, commands[-1].target) == (Phase.APPROACHING, edge)


@pytest.mark.parametrize("repeat", [1, 2, 5])
def test_a_correction_is_applied_once(repeat):
    state, _ = run(TO_DECISION)
    moves = []
    for _ in range(repeat):
        state, commands = step(state, service(correction(1)))
        moves += commands
    assert len(moves) == 1
    state, again = run([service(correction(1)), at(APPROACH), service(correction(1))], state)
    assert [c.motion for c in again if isinstance(c, Move)] == ["travel"]


@pytest.mark.parametrize(
    "message",
    [
        correction(1, dx=math.nan),
        correction(1, dtheta=math.inf),
        correction(1, dx=16.5),
        correction(1, dtheta=-16.5),
        correction(2),
        correction(1, insertion_id="other"),
        no_decision(1, "non_finite"),
        wire.Fault(insertion_id=ID, code="internal", detail="y", fatal=False),
        wire.Finished(insertion_id=ID, outcome="failed", attempts=1),
    ],
)
def test_a_decision_that_cannot_be_trusted_holds_and_moves_nothing(message):
    state, _ = run(TO_DECISION)
    state, commands = step(state, service(message))
    assert held(state, commands)


def test_a_correction_that_leaves_the_box_is_refused():
    state, _ = run(TO_DECISION)
    wide = PLAN.model_copy(update={"limits": PLAN.limits.model_copy(update={"x_mm": (-10.0, 10.0)})})
    state = State(wide, **{f: getattr(state, f) for f in ("phase", "attempt", "pose", "armed", "deadline_s")})
    state, commands = step(state, service(correction(1, dx=3.0)))
    assert "x_mm = 11" in held(state, commands)


def test_a_correction_that_comes_too_late_is_refused():
    state, _ = run(TO_DECISION)
    assert "age" in held(*step(state, service(correction(1), at_s=5.1)))


def test_no_decision_probes_the_same_spot_again_but_not_for_ever():
    state, _ = run(TO_DECISION)
    for attempt in (1, 2):
        state, commands = step(state, service(no_decision(attempt)))
        assert commands[0].target == APPROACH
        events = [at(APPROACH), at(APPROACH), service(armed(attempt + 1)), service(slip(attempt + 1))]
        state, _ = run([*events, at(APPROACH.at_height(28.0), Standstill)], state)
        assert state.armed == APPROACH
    assert held(*step(state, service(no_decision(3))))


@pytest.mark.parametrize("reason", ["contradictory", "non_finite"])
def test_a_reason_that_ends_an_insertion_at_once_is_told_once(reason):
    state, _ = run(TO_DECISION)
    state, _ = step(state, service(no_decision(1, reason)))
    assert state.reason == f"service: {reason}: d"


def test_a_lost_part_stops_the_descent_and_is_reported_as_dropped():
    state, commands = run([*TO_DESCENT, PartLost(at_s=0.0)])
    assert (state.phase, type(commands[-1])) == (Phase.STOPPING, Hold)
    state, commands = step(state, at(APPROACH.at_height(20.0), Standstill))
    assert state.phase is Phase.FAILED
    assert commands[0].message.outcome == "dropped"


def test_fifteen_attempts_are_enough():
    state, _ = run(TO_ARMING)
    for attempt in range(1, 16):
        here = state.armed
        blocked = [service(armed(attempt)), service(slip(attempt)), at(here.at_height(28.0), Standstill)]
        state, _ = run(blocked, state)
        if attempt < 15:
            state, _ = run([service(correction(attempt, 0.1, 0.1)), at(here), at(here.corrected(0.1, 0.1))], state)
    assert (state.phase, state.attempt) == (Phase.FAILED, 15)


FAST = {"speed_mm_s": 81.0, "acceleration_mm_s2": 1600.0, "jerk_mm_s3": 0.0}


@pytest.mark.parametrize("motion", ["travel", "descend", "retract"])
@pytest.mark.parametrize("name", list(FAST))
def test_ramps_that_the_limits_would_break_off_on_the_way_never_start(motion, name):
    ramp = PLAN.ramps.of(motion).model_copy(update={name: FAST[name]})
    hasty = PLAN.model_copy(update={"ramps": PLAN.ramps.model_copy(update={motion: ramp})})
    assert f"ramps.{motion}.{name}" in held(*step(State(hasty), TO_ARMING[0]))


def test_a_fault_of_the_connection_itself_is_told_in_its_own_words():
    fault = wire.Fault(insertion_id="none", code="bad_message", detail="no hello within 30 s")
    state, _ = run([TO_ARMING[0], service(fault)])
    assert state.phase is Phase.FAILED
    assert state.reason == "service: bad_message: no hello within 30 s"
