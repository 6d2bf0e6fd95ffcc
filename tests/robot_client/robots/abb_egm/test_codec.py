"""The EGM codec carries poses exactly and refuses everything a controller must not act on."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from robot_client.insertion.geometry import Pose
from robot_client.robots.abb_egm import codec
from robot_client.robots.abb_egm import tactile_insertion_egm_pb2 as pb
from robot_client.robots.abb_egm.codec import EgmError, Guidance, RobotState

MM = st.floats(-5000, 5000)


@st.composite
def poses(draw):
    q = [draw(st.floats(-1, 1)) for _ in range(4)]
    norm = math.hypot(*q)
    q = [c / norm for c in q] if norm > 1e-3 else [1.0, 0.0, 0.0, 0.0]
    return Pose(draw(MM), draw(MM), draw(MM), *q)


@given(st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1), poses(), poses(), st.booleans(), st.booleans())
def test_robot_states_survive_the_wire(sequence, time_ms, feedback, planned, motors_on, running):
    state = RobotState(sequence, time_ms, feedback, planned, (1.0,) * 6, motors_on, running, "running", True)
    assert codec.decode_robot(codec.encode_robot(state)) == state


RAPID = pb.EgmRapidCtrlExecState


@pytest.mark.parametrize(
    ("rapid", "fit"),
    [(RAPID.RAPID_RUNNING, True), (RAPID.RAPID_UNDEFINED, True), (RAPID.RAPID_STOPPED, False), (None, False)],
)
def test_a_restarted_controller_that_calls_its_running_program_undefined_is_guided(rapid, fit):
    message = pb.EgmRobot()
    message.ParseFromString(codec.encode_robot(RobotState(5, 6, Pose(1, 2, 3))))
    message.ClearField("rapidExecState")
    if rapid is not None:
        message.rapidExecState.state = rapid
    assert (codec.decode_robot(message.SerializeToString()).unfit == "") is fit


@given(st.integers(0, 2**32 - 1), st.none() | poses())
def test_guidance_survives_the_wire(sequence, pose):
    guidance = Guidance(sequence, 4, pose)
    assert codec.decode_guidance(codec.encode_guidance(guidance)) == guidance


@given(st.integers(0, 400), st.integers(1, 255))
def test_a_damaged_byte_is_refused_or_still_finite(index, flip):
    wire = bytearray(codec.encode_robot(RobotState(5, 6, Pose(1, 2, 3), Pose(1, 2, 3), (0.0,) * 6)))
    wire[index % len(wire)] ^= flip
    try:
        state = codec.decode_robot(bytes(wire))
    except EgmError:
        return
    assert all(map(math.isfinite, (state.feedback.x_mm, *state.feedback.quaternion)))


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_non_finite_targets_never_reach_the_wire(bad):
    with pytest.raises(EgmError):
        codec.encode_guidance(Guidance(1, pose=Pose(bad, 0, 0)))
    message = pb.EgmRobot.FromString(codec.encode_robot(RobotState(1, 4, Pose(0, 0, 0))))
    message.feedBack.cartesian.pos.y = bad
    with pytest.raises(EgmError, match="finite"):
        codec.decode_robot(message.SerializeToString())


@given(st.integers(0, 2**31))
def test_the_controllers_clock_is_told_in_seconds_and_microseconds(time_ms):
    message = pb.EgmRobot.FromString(codec.encode_robot(RobotState(1, time_ms, Pose(0, 0, 0))))
    assert message.header.tm == time_ms
    assert message.feedBack.time.sec * 1_000_000 + message.feedBack.time.usec == 1000 * time_ms
    assert message.feedBack.time.usec < 1_000_000


def test_a_quaternion_that_is_no_rotation_is_refused():
    with pytest.raises(EgmError, match="norm"):
        codec.encode_guidance(Guidance(1, pose=Pose(0, 0, 0, 0.5, 0, 0, 0)))


def turned_by(angles, quaternion=None):
    """The quaternion that guidance by these angles is read as."""
    message = pb.EgmSensor()
    message.header.seqno = 1
    pose = message.planned.cartesian
    pose.pos.x, pose.pos.y, pose.pos.z = 1.0, 2.0, 3.0
    pose.euler.x, pose.euler.y, pose.euler.z = angles
    if quaternion:
        pose.orient.u0, pose.orient.u1, pose.orient.u2, pose.orient.u3 = quaternion
    return codec.decode_guidance(message.SerializeToString()).pose.quaternion


@given(st.tuples(*[st.floats(-180, 180)] * 3))
def test_euler_angles_turn_about_z_then_the_new_y_then_the_new_x(angles):
    w, x, y, z = turned_by(angles)
    expected = Rotation.from_euler("ZYX", angles[::-1], degrees=True).as_matrix()
    assert Rotation.from_quat([x, y, z, w]).as_matrix() == pytest.approx(expected, abs=1e-6)


@given(st.tuples(*[st.floats(-180, 180)] * 3), st.sampled_from([1.0, -1.0]))
def test_euler_angles_and_a_quaternion_that_say_the_same_are_one_turn(angles, sign):
    x, y, z, w = Rotation.from_euler("ZYX", angles[::-1], degrees=True).as_quat()
    both = turned_by(angles, [sign * u for u in (w, x, y, z)])
    assert both == pytest.approx(turned_by(angles), abs=1e-9)


@pytest.mark.parametrize("angles", [(0.2, 0.0, 0.0), (0.0, -5.0, 0.0), (0.0, 0.0, 90.0)])
def test_euler_angles_and_a_quaternion_that_disagree_are_refused(angles):
    with pytest.raises(EgmError, match=r"differ by"):
        turned_by(angles, (1.0, 0.0, 0.0, 0.0))


def test_oversized_datagrams_are_refused():
    with pytest.raises(EgmError, match="at most"):
        codec.decode_robot(b"\0" * 5000)


def test_absent_states_count_as_not_ready():
    whole = pb.EgmRobot.FromString(codec.encode_robot(RobotState(1, 4, Pose(0, 0, 0))))
    assert not codec.decode_robot(whole.SerializeToString()).unfit
    bare = pb.EgmRobot(header=whole.header, feedBack=whole.feedBack)
    assert codec.decode_robot(bare.SerializeToString()).unfit
