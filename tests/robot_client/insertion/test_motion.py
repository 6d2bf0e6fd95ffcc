"""Targets move smoothly, stay within the limits, freeze at once and never leap."""

import itertools
import math

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from robot_client.insertion.geometry import TOOL_DOWN, CellFrame, WorkPose, multiply, normalised, turn_quaternion
from robot_client.insertion.limits import LimitError, Limits, StepGuard
from robot_client.insertion.motion import CYCLE_S, SETTLE_S, MotionGuide, Ramp, Ramps, check_ramps
from robot_client.insertion.profile import plan_profile
from tests.robot_client.insertion.stories import RAMPS

POSITIVE = st.floats(0.5, 500)
INSIDE = st.builds(
    WorkPose, x_mm=st.floats(-40, 40), y_mm=st.floats(-20, 20), z_mm=st.floats(5, 150), yaw_deg=st.floats(-45, 45)
)


def pose(x=0.0, y=0.0, z=35.0, yaw=0.0):
    return WorkPose(x_mm=x, y_mm=y, z_mm=z, yaw_deg=yaw)


@given(st.floats(0, 300), POSITIVE, POSITIVE, st.floats(10, 50000))
def test_a_profile_ends_at_its_length_and_keeps_speed_acceleration_and_jerk(length, speed, acceleration, jerk):
    profile = plan_profile(length, speed, acceleration, jerk)
    assert profile.position(0) == 0
    assert profile.position(profile.duration_s + 1) == length
    steps = 400
    dt = max(profile.duration_s, 1e-6) / steps
    way = [profile.position(i * dt) for i in range(steps + 1)]
    v = [(b - a) / dt for a, b in itertools.pairwise(way)]
    a = [(q - p) / dt for p, q in itertools.pairwise(v)]
    j = [(q - p) / dt for p, q in itertools.pairwise(a)]
    noise = 1e-9 * max(1.0, length)
    assert min(v) >= -noise / dt
    assert max(v) <= speed * (1 + 1e-6) + noise / dt
    assert max(map(abs, a)) <= acceleration * (1 + 1e-6) + noise / dt**2
    assert max(map(abs, j)) <= jerk * (1 + 1e-6) + noise / dt**3


@pytest.mark.parametrize("bad", [math.nan, math.inf, -1.0, 0.0])
def test_a_profile_refuses_limits_that_are_none(bad):
    with pytest.raises(ValueError, match="finite"):
        plan_profile(1.0, bad, 1.0, 1.0)


@given(INSIDE, INSIDE, st.sampled_from(["travel", "descend", "retract"]), st.integers(1, 3))
def test_every_target_of_every_move_passes_the_limits(start, end, motion, slow):
    guide = MotionGuide(Limits(), RAMPS, start)
    guide.move(end, motion, 1e9 if motion == "descend" else None)
    dt = CYCLE_S * slow
    for _ in range(40000):
        guide.advance(dt, 0.0)
        if not guide.moving:
            break
    assert guide.target == end


@given(INSIDE, INSIDE, st.floats(2, 80), st.floats(20, 1500), st.floats(0.8, 1.5), st.floats(0.8, 1.5))
@example(pose(yaw=-45.0), pose(yaw=45.0), 80.0, 300.0, 0.6, 1.0)
def test_limits_that_accept_a_ramp_interrupt_no_turn_on_it(start, end, speed, acceleration, speed_room, room):
    ramp = Ramp(speed_mm_s=speed, acceleration_mm_s2=acceleration, jerk_mm_s3=5000.0)
    ramps, turn_deg_s = Ramps(travel=ramp, descend=ramp, retract=ramp), min(speed, 55.0)
    limits = Limits(
        max_descent_speed_mm_s=80.0,
        max_turn_deg_s=speed_room * turn_deg_s,
        max_turn_acceleration_deg_s2=room * acceleration * turn_deg_s / speed,
    )
    try:
        check_ramps(limits, ramps)
    except LimitError:
        assert min(speed_room, room) <= 1.0, "none is refused that is within the limits"
        return
    guide = MotionGuide(limits, ramps, start)
    guide.move(end, "travel")
    for _ in range(40000):
        guide.advance(CYCLE_S, 0.0)
        if not guide.moving:
            break
    assert guide.target == end


@given(st.floats(-5, 5), st.integers(0, 300))
def test_a_hold_freezes_the_target_at_once(x, cycles):
    guide = MotionGuide(Limits(), RAMPS, pose(x=x))
    guide.move(pose(x=x, z=10.0), "descend", 1e9)
    for _ in range(cycles):
        guide.advance(CYCLE_S, 0.0)
    held = guide.target
    guide.hold()
    for _ in range(10):
        assert guide.advance(CYCLE_S, 0.0) == held


def test_over_a_gap_in_the_stream_the_target_takes_three_cycles_of_way_and_then_gains_speed_again():
    guide = MotionGuide(Limits(), RAMPS, pose())
    guide.move(pose(z=10.0), "descend", 1e9)
    for _ in range(200):
        guide.advance(CYCLE_S, 0.0)
    before = guide.target
    assert before.z_mm - guide.advance(0.5, 0.0).z_mm == pytest.approx(30.0 * CYCLE_S)
    before = guide.target
    for _ in range(100):
        after = guide.advance(CYCLE_S, 0.0)
        assert 0 <= before.z_mm - after.z_mm <= 10.0 * CYCLE_S * 1.001
        before = after
    assert before.z_mm < 32


def test_the_time_that_a_gap_cost_a_descent_is_known_once():
    """Compared with a guide without the gap: so much later it is at the same height."""
    late, prompt = MotionGuide(Limits(), RAMPS, pose()), MotionGuide(Limits(), RAMPS, pose())
    for guide, steps_s in ((late, [*[CYCLE_S] * 100, 0.5, *[CYCLE_S] * 150]), (prompt, [CYCLE_S] * 250)):
        guide.move(pose(z=10.0), "descend", 1e9)
        for step_s in steps_s:
            guide.advance(step_s, 0.0)
    behind_s = (late.target.z_mm - prompt.target.z_mm) / 10.0
    assert late.take_lost_s() == pytest.approx(0.5 + behind_s, abs=1e-6)
    assert late.take_lost_s() == prompt.take_lost_s() == 0.0


def test_a_gap_in_which_the_lease_ends_costs_the_time_before_that_as_well():
    """The time after it is the pause, of which the service is told otherwise."""
    guide, now_s = MotionGuide(Limits(), RAMPS, pose()), 0.0
    guide.move(pose(z=10.0), "descend", 0.5)
    while now_s < 0.3:
        now_s += CYCLE_S
        guide.advance(CYCLE_S, now_s)
    guide.take_lost_s()
    guide.advance(0.55 - now_s, 0.55)
    assert guide.pauses_n == 1
    assert guide.take_lost_s() == pytest.approx(0.5 - now_s)


@given(st.lists(st.sampled_from([0, 1, 2, 3, 4, 5, 8, 13, 14, 15, 40, 500]), min_size=5, max_size=60), INSIDE, INSIDE)
@example([40, 2, 13, 14, 1], pose(z=5.0), pose(z=5.0, yaw=8.0))
def test_no_rhythm_of_the_stream_makes_a_move_unlawful_or_endless(rhythm_ms, start, end):
    guide = MotionGuide(Limits(), RAMPS, start)
    guide.move(end, "travel")
    left = 30_000
    while guide.moving and left:
        for cycle_ms in [*rhythm_ms, 4]:
            guide.advance(cycle_ms / 1000.0, 0.0)
            left -= 1
            if not left:
                break
    assert guide.target == end


def test_the_descent_reaches_ten_mm_per_second_and_takes_the_way_straight_down():
    guide = MotionGuide(Limits(), RAMPS, pose(x=3, yaw=7))
    guide.move(pose(x=3, yaw=7, z=10.0), "descend", 1e9)
    steps = []
    while guide.moving:
        before = guide.target
        after = guide.advance(CYCLE_S, 0.0)
        steps.append((before.z_mm - after.z_mm) / CYCLE_S)
        assert (after.x_mm, after.y_mm, after.yaw_deg) == (3, 0, 7)
    assert max(steps) == pytest.approx(10.0)


@pytest.mark.parametrize(
    "target", [pose(x=40.1), pose(x=-41), pose(y=21), pose(z=4.9), pose(z=151), pose(yaw=46), pose(yaw=-46)]
)
def test_no_move_leaves_the_box(target):
    guide = MotionGuide(Limits(), RAMPS, pose())
    with pytest.raises(LimitError, match="allowed"):
        guide.move(target, "travel")
    assert not guide.moving


def test_the_step_guard_refuses_what_is_too_fast_too_sudden_or_timeless():
    guard = StepGuard(Limits(), pose())
    for target, elapsed in ((pose(x=1.0), 0.004), (pose(x=0.1), 0.004), (pose(yaw=0.5), 0.004), (pose(x=0.01), 0.0)):
        with pytest.raises(LimitError):
            guard.check(target, elapsed, "travel")
    assert guard.last == pose()
    assert guard.check(pose(), math.nan, "travel") == pose(), "a hold is never refused"


@st.composite
def rotations(draw):
    q = [draw(st.floats(-1, 1)) for _ in range(4)]
    return normalised(tuple(q)) if math.hypot(*q) > 1e-2 else (1.0, 0.0, 0.0, 0.0)


ANGLE = st.floats(-720, 720) | st.sampled_from([0, 90, -90, 180, -180, 360, 179.9999, -179.9999])


@given(rotations(), ANGLE, st.floats(-16, 16))
def test_a_yaw_correction_turns_about_the_vertical_of_the_work_object_through_the_tcp(rotation, yaw, turn):
    frame = CellFrame(origin_mm=(10.0, 20.0, 30.0), rotation=rotation)
    before = frame.to_controller(pose(x=5, yaw=yaw))
    after = frame.to_controller(pose(x=5, yaw=yaw).corrected(0.0, turn))
    assert (before.x_mm, before.y_mm, before.z_mm) == pytest.approx((after.x_mm, after.y_mm, after.z_mm))
    expected = multiply(multiply(multiply(rotation, turn_quaternion(yaw + turn)), TOOL_DOWN), (1, 0, 0, 0))
    dot = sum(a * b for a, b in zip(after.quaternion, expected, strict=True))
    assert abs(dot) == pytest.approx(1.0)


def test_arrival_is_reported_once_after_settling():
    guide = MotionGuide(Limits(), RAMPS, pose())
    guide.move(pose(x=1), "travel")
    now, settled = 0.0, []
    for _ in range(2000):
        now += CYCLE_S
        measured = guide.advance(CYCLE_S, 0.0)
        settled.append(guide.observe(measured, now))
    assert [t for t in settled if t] == ["arrived"]


def test_standstill_waits_for_the_lagging_arm():
    guide = MotionGuide(Limits(), RAMPS, pose())
    guide.move(pose(z=10), "descend", 1e9)
    measured, now = 35.0, 0.0
    for _ in range(250):
        now += CYCLE_S
        measured += (guide.advance(CYCLE_S, 0.0).z_mm - measured) * CYCLE_S / 0.05
        assert guide.observe(pose(z=measured), now) is None
    guide.hold()
    slip_z = measured
    way = [measured]
    while guide.observe(pose(z=measured), now) is None:
        now += CYCLE_S
        measured += (guide.target.z_mm - measured) * CYCLE_S / 0.05
        way.append(measured)
    assert way[-round(SETTLE_S / CYCLE_S)] - measured < 0.02, "it stood for as long as its driver says"
    assert slip_z - measured == pytest.approx(0.5, abs=0.06), "overtravel is lag times speed"
