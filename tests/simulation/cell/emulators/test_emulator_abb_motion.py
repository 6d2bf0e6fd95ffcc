"""The arm's motion under guidance, and its kinematics."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from simulation.cell.emulators.abb.frames import CellFrames
from simulation.cell.emulators.abb.irb1600 import FLANGE_FRAME, ReachError, inverse
from simulation.cell.emulators.abb.motion import Follower, MotionLimits, Pose, rotation_between, tool_down

ANGLES = st.floats(-170, 170)


def forward(joints_deg):
    """Place and axes of tool0 in the base for six joint angles, from the data sheet's lengths."""
    j1, j2, j3, *wrist = np.radians(joints_deg)
    shoulder, elbow = Rotation.from_euler("Z", j1), Rotation.from_euler("ZY", [j1, j2])
    forearm = Rotation.from_euler("ZY", [j1, j2 + j3])
    arm = forearm * Rotation.from_euler("XYX", wrist)
    place = shoulder.apply([150, 0, 486.5]) + elbow.apply([0, 0, 700]) + forearm.apply([600, 0, 0])
    return place + arm.apply([65, 0, 0]), arm.as_matrix() @ FLANGE_FRAME


def follower(**limits) -> Follower:
    arm = Follower(Pose((0.0, 0.0, 35.0)), MotionLimits(**limits))
    arm.braking = False
    return arm


@pytest.mark.parametrize("lag_s", [0.02, 0.05])
def test_the_arm_follows_a_step_with_the_stated_lag(lag_s):
    arm = follower(lag_s=lag_s, acceleration_mm_s2=1e6)
    arm.target = Pose((0.2, 0.0, 35.0))
    arm.advance(lag_s)
    assert arm.pose.position_mm[0] == pytest.approx(0.2 * (1 - math.exp(-1)), rel=1e-6)


@pytest.mark.parametrize("lag_s", [0.02, 0.05])
def test_overtravel_after_the_target_freezes_is_speed_times_lag(lag_s):
    arm = follower(lag_s=lag_s)
    for k in range(250):
        arm.target = Pose((0.0, 0.0, 35.0 - 0.04 * k))
        arm.advance(0.004)
    z_frozen = arm.pose.position_mm[2]
    arm.advance(1.0)
    assert z_frozen - arm.pose.position_mm[2] == pytest.approx(10.0 * lag_s, abs=0.045)


@given(st.lists(st.tuples(st.floats(-300, 300), st.floats(-90, 90)), min_size=1, max_size=8))
def test_no_target_makes_the_arm_exceed_its_limits(targets):
    arm = follower()
    limits = arm.limits
    for x, yaw in targets:
        arm.target = Pose((x, 0.0, 35.0), tool_down(yaw))
        for _ in range(40):
            before = arm.velocity_mm_s
            arm.advance(0.002)
            assert math.dist((0, 0, 0), arm.velocity_mm_s) <= limits.speed_mm_s * (1 + 1e-9)
            assert math.dist(before, arm.velocity_mm_s) <= limits.acceleration_mm_s2 * 0.002 * (1 + 1e-9)
            assert math.dist((0, 0, 0), arm.turn_rad_s) <= limits.turn_rad_s * (1 + 1e-9)


@pytest.mark.parametrize("distance", [0.1, 5.0, 200.0])
def test_the_arm_comes_to_rest_on_its_target(distance):
    arm = follower()
    arm.target = Pose((distance, 0.0, 35.0), tool_down(10.0))
    farthest = 0.0
    for _ in range(2000):
        arm.advance(0.002)
        farthest = max(farthest, arm.pose.position_mm[0])
    assert arm.pose.position_mm[0] == pytest.approx(distance, abs=1e-6)
    assert arm.pose.yaw_deg == pytest.approx(10.0, abs=1e-6)
    assert farthest <= distance + 0.3
    assert arm.at_rest


def test_braking_comes_to_rest_on_the_stop_ramp():
    arm = follower()
    arm.target = Pose((500.0, 0.0, 35.0))
    arm.advance(0.5)
    start, speed = arm.pose.position_mm[0], arm.velocity_mm_s[0]
    arm.braking = True
    arm.advance(1.0)
    assert arm.at_rest
    assert arm.pose.position_mm[0] - start <= speed**2 / (2 * arm.limits.stop_deceleration_mm_s2) + speed * 0.002


def test_yaw_reads_back_in_both_tool_conventions():
    for yaw in (-170.0, -12.0, 0.0, 6.0, 90.0, 179.0):
        assert Pose((0, 0, 0), tool_down(yaw)).yaw_deg == pytest.approx(yaw)
        up = (math.cos(math.radians(yaw) / 2), 0.0, 0.0, math.sin(math.radians(yaw) / 2))
        assert Pose((0, 0, 0), up).yaw_deg == pytest.approx(yaw)
        assert Pose((0, 0, 0), up).tilt_deg == pytest.approx(0.0, abs=1e-4)


def test_rotation_between_takes_the_short_way_at_any_angle():
    for a, b in ((-170.0, 170.0), (0.0, 180.0), (10.0, 10.0)):
        turn = rotation_between(tool_down(a), tool_down(b))
        assert abs(math.degrees(turn[2])) == pytest.approx(min(abs(b - a), 360 - abs(b - a)), abs=1e-6)


@given(ANGLES, st.floats(-60, 100), st.floats(-80, 60), ANGLES, st.floats(1, 115), ANGLES)
def test_joints_and_poses_are_inverse(j1, j2, j3, j4, j5, j6):
    position, rotation = forward((j1, j2, j3, j4, j5, j6))
    try:
        back = forward(inverse(position, rotation))
    except ReachError:
        return
    np.testing.assert_allclose(back[0], position, atol=1e-6)
    np.testing.assert_allclose(back[1], rotation, atol=1e-8)


def test_the_zero_pose_is_that_of_the_data_sheet():
    position, rotation = forward((0.0,) * 6)
    np.testing.assert_allclose(position, [150.0 + 600.0 + 65.0, 0.0, 486.5 + 700.0], atol=1e-9)
    np.testing.assert_allclose(rotation[:, 2], [1.0, 0.0, 0.0], atol=1e-12)


def test_out_of_reach_is_refused():
    with pytest.raises(ReachError, match="reach"):
        inverse(np.array([3000.0, 0.0, 0.0]), np.eye(3))


@given(st.floats(-40, 40), st.floats(-150, 150))
def test_joints_lead_back_to_the_pose_in_the_work_object(x, yaw):
    frames, pose = CellFrames(), Pose((x, 1.0, 35.0), tool_down(yaw))
    position, rotation = forward(frames.joints_deg(pose))
    tcp = position + frames.tool_length_mm * rotation[:, 2]
    np.testing.assert_allclose(tcp - frames.work_object_mm, pose.position_mm, atol=1e-6)
    wanted = Rotation.from_quat(pose.quaternion, scalar_first=True)
    np.testing.assert_allclose(rotation, wanted.as_matrix(), atol=1e-8)
