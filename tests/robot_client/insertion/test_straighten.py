"""The tool is tilted to hold a turned object upright: once in an attempt, in the air, within its bound."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_client.cli.insert import make_plan
from robot_client.insertion.events import Hold, Move, Send, Standstill
from robot_client.insertion.geometry import CellFrame, WorkPose
from robot_client.insertion.limits import LimitError, Limits, StepGuard, check_pose
from robot_client.insertion.machine import Phase, State, step
from robot_client.insertion.motion import CYCLE_S, MotionGuide
from robot_client.session.report import Report
from robot_client.settings import load_settings
from service.contract import wire
from tests.robot_client.insertion.stories import (
    APPROACH,
    ID,
    PLAN,
    RAMPS,
    TO_ARMING,
    TO_DECISION,
    armed,
    at,
    correction,
    held,
    run,
    service,
)

SIGNED = PLAN.model_copy(update={"signs_known": True})
LEAN_DEG = -0.8


def straighten(attempt, tilt_deg=LEAN_DEG):
    return service(wire.Straighten(insertion_id=ID, attempt=attempt, tilt_deg=tilt_deg, detail="turned"))


def sent(commands, kind):
    return [command.message for command in commands if isinstance(command, Send) and isinstance(command.message, kind)]


def second_arming():
    state, _ = run(TO_DECISION, State(SIGNED))
    up = APPROACH.corrected(-3.0, -2.0)
    state, commands = run([service(correction(1)), at(APPROACH.at_height(33.0)), at(up)], state)
    assert state.phase is Phase.ARMING
    assert state.attempt == 2
    return state, sent(commands, wire.Arm)[-1]


@pytest.mark.parametrize("signs_known", [False, True])
def test_level_tops_are_told_only_where_the_wiring_check_has_shown_the_signs_of_tilts(signs_known):
    plan = PLAN.model_copy(update={"signs_known": signs_known, "tops_level_mm": 0.2})
    (asked,) = sent(run(TO_ARMING, State(plan))[1], wire.Arm)
    assert asked.tops_level_mm == (0.2 if signs_known else None)


@pytest.mark.parametrize("neighbours_stay", [False, True])
def test_that_the_neighbours_stay_is_told_as_it_was_stated(neighbours_stay):
    task = {"neighbours_stay": neighbours_stay} if neighbours_stay else {}
    plan = make_plan(load_settings(None, {"task": task}), 0.0, 0.0, "t-1", None)
    (asked,) = sent(run(TO_ARMING, State(plan))[1], wire.Arm)
    assert asked.neighbours_stay == neighbours_stay


def test_a_turned_object_is_straightened_and_the_attempt_keeps_its_number_and_its_place():
    state, asked = second_arming()
    above = state.armed
    state, (move,) = run([straighten(2)], state)
    assert isinstance(move, Move)
    assert move.target == above.tilted(LEAN_DEG)
    state, commands = run([at(move.target)], state)
    assert sent(commands, wire.Arm) == [asked.model_copy(update={"tilt_deg": LEAN_DEG})]
    assert state.attempt == 2
    state, commands = run([service(armed(2))], state)
    descent = next(command for command in commands if isinstance(command, Move))
    assert descent.target == above.tilted(LEAN_DEG).at_height(descent.target.z_mm), "it descends with its tilt"


def test_an_attempt_armed_twice_is_one_row_of_the_report_and_says_its_tilt():
    shown = []
    report, state = Report(lambda: None, shown.append), State(SIGNED)
    up = APPROACH.corrected(-3.0, -2.0)
    story = [*TO_DECISION, service(correction(1)), at(APPROACH.at_height(33.0)), at(up), straighten(2)]
    for event in [*story, at(up.tilted(LEAN_DEG)), service(armed(2)), service(correction(2))]:
        state, _ = step(state, event)
        report.on_event(state, event)
    assert [(row.attempt, row.tilt_deg) for row in report.rows] == [(1, 0.0), (2, LEAN_DEG)]
    assert "attempt  2  at x  +5.00 mm, yaw  +4.00 deg, tool tilted -0.8 deg" in shown[-3]


def test_later_attempts_keep_the_tilt_until_another_is_asked_for():
    state, _ = second_arming()
    leaning = state.armed.tilted(LEAN_DEG)
    state, _ = run([straighten(2), at(leaning), service(armed(2))], state)
    state, _ = run([service(slip_of(2)), at(leaning.at_height(28.0), Standstill), service(correction(2))], state)
    corners = [state.path[0]]
    state, commands = run([at(leaning), at(corners[0])], state)
    assert {corner.tilt_deg for corner in corners} == {LEAN_DEG}
    assert [arm.attempt for arm in sent(commands, wire.Arm)] == [3]
    state, (move,) = run([straighten(3, 0.0)], state)
    assert move.target == corners[0].tilted(0.0).at_height(move.target.z_mm)


def slip_of(attempt):
    return wire.Slip(
        insertion_id=ID, attempt=attempt, finger="left", frame_seq=1, captured_ns=1, age_ms=1.0, score=9.0, reason="r"
    )


@pytest.mark.parametrize(
    ("limits", "tilt_deg", "says"),
    [
        (Limits(), 1.6, "tilt_deg = 1.600, allowed up to 1.5"),
        (Limits(), float("nan"), "tilt_deg = nan"),
        (Limits(max_straighten_deg=0.0), 0.1, "allowed up to 0"),
    ],
)
def test_a_tilt_beyond_the_bound_is_refused_and_nothing_moves(limits, tilt_deg, says):
    state, _ = second_arming()
    state = replace(state, plan=state.plan.model_copy(update={"limits": limits}))
    message = wire.Straighten.model_construct(
        type="straighten", insertion_id=ID, attempt=2, tilt_deg=tilt_deg, detail="d"
    )
    assert says in held(*step(state, service(message)))


@pytest.mark.parametrize(
    ("plan", "tilt_deg", "says"),
    [
        (PLAN, 0.2, "tilt_deg = 0.200, allowed up to 0 "),
        (SIGNED.model_copy(update={"limits": Limits(max_tilt_deg=1.0)}), 0.9, "tilt_deg = 0.900, allowed up to 0.5 "),
    ],
)
def test_a_service_that_asks_for_more_than_the_client_offered_is_not_followed(plan, tilt_deg, says):
    """Where nobody has checked the signs, the tool might tilt the wrong way."""
    state, commands = run([*TO_ARMING, straighten(1, tilt_deg)], State(plan))
    assert state.phase is Phase.FAILED
    assert says in state.reason
    assert [type(command) for command in commands[-2:]] == [Hold, Send]


def test_a_service_that_asks_again_and_again_is_not_followed():
    state, _ = second_arming()
    leaning = state.armed.tilted(LEAN_DEG)
    state, _ = run([straighten(2), at(leaning), straighten(2, 0.5)], state)
    assert state.phase is Phase.FAILED
    assert "asked to tilt the tool again" in state.reason


def test_a_late_request_changes_nothing():
    state, _ = run([*TO_ARMING, service(armed(1))], State(SIGNED))
    assert run([straighten(1)], state) == (state, [])


def test_a_client_says_how_far_it_may_tilt_if_its_signs_are_known_and_as_its_limits_allow():
    narrow = SIGNED.model_copy(update={"limits": Limits(max_tilt_deg=1.0)})
    tight = SIGNED.model_copy(update={"limits": Limits(max_tilt_deg=0.3)})
    for plan, most_deg in ((PLAN, 0.0), (SIGNED, 1.5), (narrow, 0.5), (tight, 0.0)):
        _, commands = run(TO_ARMING, State(plan))
        assert [hello.most_tilt_deg for hello in sent(commands, wire.ClientHello)] == [most_deg]


def test_a_regrasped_object_is_held_by_an_upright_tool():
    state, _ = second_arming()
    state, _ = run([straighten(2), at(state.armed.tilted(LEAN_DEG))], state)
    refused = wire.Refused(insertion_id=ID, attempt=2, reason="turned_in_hand", detail="too far")
    state, _ = run([service(refused)], replace(state, plan=state.plan.model_copy(update={"fixture": True})))
    assert state.afresh("next").approach.tilt_deg == 0.0


# ---- geometry and bounds --------------------------------------------------------------------------------------------


@given(
    st.floats(-400.0, 400.0),
    st.floats(-80.0, 80.0),
    st.tuples(*[st.floats(-1.0, 1.0)] * 4),
    st.tuples(*[st.floats(-2000.0, 2000.0)] * 3),
)
def test_a_pose_survives_the_way_to_the_controller_and_back(yaw_deg, tilt_deg, rotation, origin_mm):
    turned = rotation if sum(abs(v) for v in rotation) > 0.1 else (1.0, 0.0, 0.0, 0.0)
    frame = CellFrame(origin_mm=origin_mm, rotation=turned)
    start = WorkPose(x_mm=1.0, y_mm=2.0, z_mm=3.0, yaw_deg=yaw_deg, tilt_deg=tilt_deg)
    back, leans_deg = frame.from_controller(frame.to_controller(start), near_yaw_deg=yaw_deg)
    assert (back.x_mm, back.y_mm, back.z_mm) == pytest.approx((1.0, 2.0, 3.0), abs=1e-9)
    assert back.turn_deg(start) < 1e-6
    assert leans_deg == pytest.approx(abs(tilt_deg), abs=1e-6)


def test_the_tool_tilts_about_the_axis_along_which_its_fingers_close():
    """At yaw 90 deg that axis points to -x of the work object: the tool's own x axis dips towards y."""
    pose = CellFrame(tool=(1.0, 0.0, 0.0, 0.0)).to_controller(
        WorkPose(x_mm=0, y_mm=0, z_mm=0, yaw_deg=90.0, tilt_deg=30.0)
    )
    w, x, y, z = pose.quaternion
    own_x = (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y))
    assert own_x == pytest.approx((0.0, 0.75**0.5, -0.5), abs=1e-9)


def test_a_tilted_target_is_bounded_in_angle_and_in_speed():
    with pytest.raises(LimitError, match=r"tilt_deg = 2\.100, allowed up to 2 either way"):
        check_pose(Limits(), APPROACH.tilted(2.1))
    guard = StepGuard(Limits(), APPROACH)
    with pytest.raises(LimitError, match="turn deg/s"):
        guard.check(APPROACH.tilted(1.0), CYCLE_S, "travel")


def test_a_tilt_is_walked_within_the_limits_and_settles_when_the_arm_has_it():
    guide, now_s = MotionGuide(Limits(), RAMPS, APPROACH), 0.0
    guide.move(APPROACH.tilted(LEAN_DEG), "travel")
    tilts = []
    while guide.moving:
        now_s += CYCLE_S
        tilts.append(guide.advance(CYCLE_S, now_s).tilt_deg)
    assert tilts[-1] == LEAN_DEG
    assert tilts == sorted(tilts, reverse=True)
    assert len(tilts) > 5, "it turns there, it does not jump"
    for n in range(40):
        assert guide.observe(APPROACH, now_s + n * CYCLE_S) is None, "the arm has not tilted yet"
    settled = [guide.observe(APPROACH.tilted(LEAN_DEG), now_s + (41 + n) * CYCLE_S) for n in range(40)]
    assert [one for one in settled if one] == ["arrived"]
