"""Each bound at its value: what lies just within is done, what lies just beyond is refused."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from robot_client.insertion.geometry import CellFrame, Pose, WorkPose, normalised
from robot_client.insertion.lease import PAUSE_S, Lease, Unwatched
from robot_client.insertion.limits import LimitError, Limits, StepGuard, check_correction
from robot_client.insertion.motion import CYCLE_S, SETTLE_S, MotionGuide, Ramp, Ramps
from robot_client.insertion.pace import Pace
from robot_client.insertion.state import Plan
from service.contract import wire
from service.contract.wire import MAX_ATTEMPTS
from tests.robot_client.insertion.stories import APPROACH, ID, PLAN, RAMPS

WIDE = 1e12
FREE = Limits(max_acceleration_mm_s2=WIDE, max_turn_acceleration_deg_s2=WIDE)
AT = WorkPose(x_mm=3.0, y_mm=-4.0, z_mm=50.0, yaw_deg=7.0)
WAYS = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda way: math.hypot(*way) > 0.1)
STEPS_S = st.floats(0.002, 0.02)
NEARLY = st.sampled_from([0.99, 1.0, 1.01])


def moved(start, way, mm, turn_deg=0.0):
    """The pose ``mm`` further along ``way``."""
    x, y, z = (mm * part / math.hypot(*way) for part in way)
    return WorkPose(x_mm=start.x_mm + x, y_mm=start.y_mm + y, z_mm=start.z_mm + z, yaw_deg=start.yaw_deg + turn_deg)


def passes(guard, target, elapsed_s, motion="travel"):
    try:
        return guard.check(target, elapsed_s, motion) == target
    except LimitError:
        return False


@given(WAYS, STEPS_S, NEARLY, st.sampled_from([("travel", 80.0), ("retract", 80.0), ("descend", 15.0)]))
def test_no_step_in_any_direction_is_faster_than_its_kind_of_motion_may_be(way, elapsed_s, share, kind):
    motion, most_mm_s = kind
    target = moved(AT, way, share * most_mm_s * elapsed_s)
    assert passes(StepGuard(FREE, AT), target, elapsed_s, motion) == (share <= 1.0)


@given(STEPS_S, NEARLY, st.sampled_from([1.0, -1.0]))
def test_no_step_turns_faster_than_the_arm_may(elapsed_s, share, side):
    target = moved(AT, (1, 0, 0), 0.0, side * share * 60.0 * elapsed_s)
    assert passes(StepGuard(FREE, AT), target, elapsed_s) == (share <= 1.0)


def under_way(way, speed_mm_s, turn_deg_s, elapsed_s, limits):
    """A guard after a step at these speeds, which from now on has these limits."""
    guard = StepGuard(FREE, AT)
    assert passes(guard, moved(AT, way, speed_mm_s * elapsed_s, turn_deg_s * elapsed_s), elapsed_s)
    guard.limits = limits
    return guard


@given(WAYS, WAYS, STEPS_S, STEPS_S, NEARLY)
def test_the_speed_changes_no_harder_than_allowed_over_the_time_between_two_steps(way, change, first_s, then_s, share):
    guard = under_way(way, 20.0, 0.0, first_s, Limits(max_acceleration_mm_s2=700.0))
    before = AT, guard.last
    went = [(b - a) / first_s for a, b in zip(*[(p.x_mm, p.y_mm, p.z_mm) for p in before], strict=True)]
    more = [share * 700.0 * (first_s + then_s) / 2 * part / math.hypot(*change) for part in change]
    speed = [a + b for a, b in zip(went, more, strict=True)]
    if sum(a * b for a, b in zip(speed, went, strict=True)) < sum(a * a for a in went) and share > 1.0:
        return  # it may be slowing down, which is never refused
    target = moved(guard.last, speed, math.hypot(*speed) * then_s)
    assert passes(guard, target, then_s) == (share <= 1.0)


@given(STEPS_S, STEPS_S, NEARLY, st.sampled_from([1.0, -1.0]))
def test_the_turn_changes_no_harder_than_allowed_either(first_s, then_s, share, side):
    guard = under_way((1, 0, 0), 0.0, 20.0, first_s, Limits(max_turn_acceleration_deg_s2=700.0))
    turn_deg_s = 20.0 + side * share * 700.0 * (first_s + then_s) / 2
    if 0.0 <= turn_deg_s <= 20.0:
        return  # slowing down
    target = moved(guard.last, (1, 0, 0), 0.0, turn_deg_s * then_s)
    assert passes(guard, target, then_s) == (share <= 1.0)


STRICT = Limits(max_acceleration_mm_s2=0.01, max_turn_acceleration_deg_s2=0.01)


@given(WAYS, STEPS_S, st.floats(0.01, 1.0))
def test_slowing_down_on_the_way_is_never_refused(way, elapsed_s, share):
    guard = under_way(way, 20.0, 10.0, elapsed_s, STRICT)
    here = guard.last
    steps = [(b - a) * share for a, b in zip(*[(p.x_mm, p.y_mm, p.z_mm) for p in (AT, here)], strict=True)]
    turned = here.yaw_deg + 10.0 * elapsed_s * share
    target = WorkPose(x_mm=here.x_mm + steps[0], y_mm=here.y_mm + steps[1], z_mm=here.z_mm + steps[2], yaw_deg=turned)
    assert passes(guard, target, elapsed_s)
    assert passes(guard, target, elapsed_s), "and standing even less"


@pytest.mark.parametrize(
    ("forwards", "aside", "turn"), [(1.05, 0.0, 1.05), (-0.05, 0.0, -0.05), (0.5, 0.05, 0.5), (0.5, 0.0, 0.45)]
)
def test_a_step_that_goes_back_aside_or_on_faster_is_not_slowing_down(forwards, aside, turn):
    guard = under_way((1, 0, 0), 20.0, 10.0, 0.004, STRICT)
    way = (20.0 * forwards, 20.0 * aside, 0.0)
    target = moved(guard.last, way, math.hypot(*way) * 0.004, 10.0 * turn * 0.004)
    assert not passes(guard, target, 0.004)


@given(st.sampled_from(["yaw_deg", "tilt_deg"]), st.sampled_from([-1.0, 1.0]), STEPS_S, NEARLY)
def test_a_turn_from_rest_is_the_same_in_yaw_and_tilt_and_either_sense(angle, sense, elapsed_s, share):
    guard = under_way((1, 1, 1), 20.0, 10.0, elapsed_s, FREE)
    assert passes(guard, guard.last, elapsed_s)
    guard.limits = Limits(max_acceleration_mm_s2=WIDE, max_turn_acceleration_deg_s2=700.0)
    turned_deg = getattr(guard.last, angle) + sense * share * 700.0 * elapsed_s**2
    target = guard.last.model_copy(update={angle: turned_deg})
    assert passes(guard, target, elapsed_s) == (share <= 1.0)


@given(WAYS, STEPS_S, NEARLY)
def test_after_a_stand_a_step_begins_from_rest_in_every_direction(way, elapsed_s, share):
    guard = under_way((1, 1, 1), 20.0, 10.0, elapsed_s, FREE)
    assert passes(guard, guard.last, elapsed_s)
    guard.limits = Limits(max_acceleration_mm_s2=700.0, max_turn_acceleration_deg_s2=WIDE)
    assert passes(guard, moved(guard.last, way, share * 700.0 * elapsed_s**2), elapsed_s) == (share <= 1.0)


@pytest.mark.parametrize(
    ("values", "beyond"),
    [
        ((15, 16.0, -16.0, 5.0), ""),
        ((1, 16.01, 0.0, 0.0), "dx_mm"),
        ((1, -16.01, 0.0, 0.0), "dx_mm"),
        ((1, 0.0, 16.01, 0.0), "dtheta_deg"),
        ((1, 0.0, -16.01, 0.0), "dtheta_deg"),
        ((1, 0.0, 0.0, 5.01), "age_s"),
        ((1, math.nan, 0.0, 0.0), "dx_mm"),
        ((1, 0.0, math.inf, 0.0), "dtheta_deg"),
        ((1, 0.0, 0.0, math.nan), "age_s"),
        ((16, 0.0, 0.0, 0.0), "attempt"),
    ],
)
def test_a_correction_may_reach_its_bounds_and_is_refused_by_name_beyond(values, beyond):
    if not beyond:
        check_correction(Limits(), *values)
        return
    with pytest.raises(LimitError, match=beyond):
        check_correction(Limits(), *values)


@pytest.mark.parametrize("name", ["gap_width_mm", "grasp_height_mm", "grip_n", "shear_reach_mm", "expected_depth_mm"])
def test_a_plan_takes_what_the_message_to_the_service_takes(name):
    usual = {"insertion_id": ID, "gap_width_mm": 56.0, "expected_depth_mm": 25.0}
    for value in (-1.0, 0.0, 0.5, 100.0, 100.5, 500.0, 500.5, 1000.0, 1000.5):
        accepted = []
        for kind, more in ((Plan, {"approach": APPROACH}), (wire.Arm, {"attempt": 1})):
            try:
                kind(**usual | more | {name: value})
                accepted.append(True)
            except ValidationError:
                accepted.append(False)
        assert accepted[0] == accepted[1], value


@pytest.mark.parametrize(
    ("kind", "name", "good", "bad"),
    [
        (Pace, "above_mm", (1.0,), (0.99,)),
        (Pace, "below_mm", (3.0,), (2.99,)),
        (Pace, "lift_mm", (2.0, None), (1.99,)),
        (Pace, "press_mm", (0.6, 3.0), (0.59, 3.01)),
        (Pace, "fast_mm_s", (0.01, None), (0.0, math.nan)),
        (Limits, "max_attempts", (1, MAX_ATTEMPTS), (0, MAX_ATTEMPTS + 1)),
        (Limits, "max_tilt_deg", (0.01, 5.0), (0.0, 5.01)),
        (Plan, "creep_allowance_mm", (0.0, 50.0), (-0.1, 50.1)),
        (Plan, "pause_s", (0.0, PAUSE_S), (-0.1, PAUSE_S + 0.01)),
        (Plan, "object", ("x" * 128,), ("x" * 129,)),
        (WorkPose, "x_mm", (1e6, -1e6), (1.01e6, -1.01e6)),
    ],
)
def test_a_table_takes_values_up_to_their_bounds(kind, name, good, bad):
    usual = {
        Plan: {"insertion_id": ID, "approach": APPROACH, "gap_width_mm": 56.0, "expected_depth_mm": 25.0},
        WorkPose: AT.model_dump(),
    }.get(kind, {})
    for value in good:
        assert getattr(kind(**usual | {name: value}), name) == value
    for value in bad:
        with pytest.raises(ValidationError, match=name):
            kind(**usual | {name: value})


@pytest.mark.parametrize(("norm", "good"), [(0.991, True), (1.009, True), (0.989, False), (1.011, False)])
def test_a_quaternion_may_be_rounded_by_a_hundredth_of_its_length(norm, good):
    pose = Pose(1.0, 2.0, 3.0, 0.0, norm, 0.0, 0.0)
    if good:
        assert pose.check() is pose
    else:
        with pytest.raises(ValueError, match="norm"):
            pose.check()


def test_a_quaternion_of_any_length_is_a_rotation_and_none_is_not():
    assert normalised((0.0, 1e-8, 0.0, 0.0)) == (0.0, 1.0, 0.0, 0.0)
    for none in ((0.0, 1e-10, 0.0, 0.0), (math.inf, 0.0, 0.0, 0.0), (math.nan, 1.0, 0.0, 0.0)):
        with pytest.raises(ValueError, match="rotation"):
            normalised(none)


@given(st.floats(0.0, 175.0), st.floats(-170.0, 170.0), st.booleans())
def test_a_tool_is_tilted_by_the_angle_between_its_axis_and_the_vertical(tilt_deg, yaw_deg, about_x):
    half, turn = math.radians(tilt_deg) / 2.0, math.radians(yaw_deg) / 2.0
    c, s = math.cos(half), math.sin(half)
    cz, sz = math.cos(turn), math.sin(turn)
    tilted = (c * cz, s * cz, -s * sz, c * sz) if about_x else (c * cz, s * sz, s * cz, c * sz)
    _, measured_deg = CellFrame(tool=(1.0, 0.0, 0.0, 0.0)).from_controller(Pose(1.0, 2.0, 3.0, *tilted))
    assert measured_deg == pytest.approx(tilt_deg, abs=1e-5)


def test_an_upright_tool_with_no_turn_named_is_the_identity():
    here, tilt_deg = CellFrame(tool=(1.0, 0.0, 0.0, 0.0)).from_controller(Pose(1.0, 2.0, 3.0))
    assert (here, tilt_deg) == (WorkPose(x_mm=1.0, y_mm=2.0, z_mm=3.0, yaw_deg=0.0), 0.0)


@pytest.mark.parametrize(
    ("legs", "motion", "good"),
    [
        (((30.0, 12.0), (20.0, 0.05)), "descend", True),
        (((30.0, 12.0), (20.0, 15.0)), "descend", True),
        (((30.0, 12.0), (20.0, 15.1)), "descend", False),
        (((30.0, 12.0), (20.0, 0.0)), "descend", False),
        (((20.0, 12.0), (30.0, 5.0)), "descend", False),
        (((30.0, 12.0), (20.0, 5.0)), "retract", False),
    ],
)
def test_legs_lead_down_to_the_end_of_a_descent_within_its_speed(legs, motion, good):
    guide = MotionGuide(Limits(), RAMPS, APPROACH)
    lease_s = 1e9 if motion == "descend" else None
    if good:
        guide.move(APPROACH.at_height(20.0), motion, lease_s, legs)
        assert guide.moving
        return
    with pytest.raises(LimitError, match="in legs"):
        guide.move(APPROACH.at_height(20.0), motion, lease_s, legs)
    assert not guide.moving


def test_an_arm_that_may_accelerate_no_harder_than_its_ramp_goes_on_after_a_pause_all_the_same():
    limits = Limits()
    ramp = Ramp(speed_mm_s=10.0, acceleration_mm_s2=limits.max_acceleration_mm_s2, jerk_mm_s3=1e5)
    guide = MotionGuide(limits, Ramps(descend=ramp), APPROACH)
    guide.move(APPROACH.at_height(20.0), "descend", until_s=0.5)
    now_s = 0.0
    while guide.moving and now_s < 10.0:
        now_s += CYCLE_S
        if now_s > 0.6:
            guide.renew(now_s + 1.0)
        guide.advance(CYCLE_S, now_s)
    assert (guide.target.z_mm, guide.pauses_n) == (20.0, 1)


def test_who_ends_a_pause_says_for_how_long_nothing_was_judged():
    guide = MotionGuide(Limits(), Ramps(), APPROACH)
    guide.move(APPROACH.at_height(20.0), "descend", until_s=0.1)
    guide.advance(CYCLE_S, 0.0)
    guide.advance(CYCLE_S, 0.1)
    guide.advance(CYCLE_S, 0.1 + PAUSE_S - 0.001)
    with pytest.raises(Unwatched, match="the lease ended 260 ms ago"):
        guide.advance(CYCLE_S, 0.36)


@pytest.mark.parametrize(
    ("off_mm", "off_deg", "arrives"), [(0.028, 0.0, True), (0.032, 0.0, False), (0.0, 0.028, True), (0.0, 0.032, False)]
)
def test_an_arm_has_arrived_once_it_rests_within_three_hundredths_of_its_target(off_mm, off_deg, arrives):
    guide = MotionGuide(Limits(), RAMPS, AT)
    guide.move(AT, "travel")
    guide.advance(CYCLE_S, 0.0)
    rests = AT.model_copy(update={"y_mm": AT.y_mm + off_mm, "yaw_deg": AT.yaw_deg + off_deg})
    reports = [guide.observe(rests, n * CYCLE_S) for n in range(30)]
    assert [n for n, settled in enumerate(reports) if settled] == ([math.ceil(SETTLE_S / CYCLE_S)] if arrives else [])


@pytest.mark.parametrize(
    ("step_mm", "step_deg", "stands"),
    [(0.014, 0.0, True), (0.016, 0.0, False), (0.0, 0.009, True), (0.0, 0.011, False)],
)
def test_an_arm_stands_while_it_stays_within_a_window(step_mm, step_deg, stands):
    """To and fro by that much from one datagram to the next."""
    guide = MotionGuide(Limits(), RAMPS, AT)
    guide.hold()
    there = AT.model_copy(update={"x_mm": AT.x_mm + step_mm, "yaw_deg": AT.yaw_deg + step_deg})
    reports = [guide.observe((AT, there)[n % 2], n * CYCLE_S) for n in range(30)]
    assert [settled for settled in reports if settled] == ["standstill"] * stands


def test_a_camera_that_does_not_tell_its_rate_is_not_too_slow():
    camera = wire.CameraEntry(finger="left", source="s", state="live", frame_rate_hz=None)
    Lease().check_rate(10.0, camera)
    PLAN.check_cameras([camera])
