"""A tool that leans a little when guidance begins: nothing turns until a move does, and then slowly."""

import itertools
import math

import pytest

from robot_client.insertion.geometry import CellFrame, Pose, WorkPose, multiply, turn_quaternion
from robot_client.insertion.limits import Limits
from robot_client.insertion.motion import CYCLE_S, Ramps
from robot_client.robots.abb_egm import codec
from robot_client.robots.abb_egm.driver import EgmArm
from robot_client.robots.abb_egm.righting import RIGHTING_DEG_S, Righting
from robot_client.robots.abb_egm.settings import Settings
from tests.robot_client.robots.abb_egm.test_driver import Wire

HERE = WorkPose(x_mm=5.0, y_mm=0.0, z_mm=60.0, yaw_deg=20.0, tilt_deg=0.4)
FRAME = CellFrame(rotation=(0.9, 0.1, -0.3, 0.2), tool=(0.0, 0.6, 0.8, 0.0))


def leaning(lean_deg, pose=HERE):
    """A tool at ``pose`` that leans about the axis across its fingers, which no target knows."""
    upright, half = FRAME.to_controller(pose), math.radians(lean_deg) / 2.0
    turned = multiply(turn_quaternion(pose.yaw_deg, pose.tilt_deg), (math.cos(half), math.sin(half), 0.0, 0.0))
    q = multiply(multiply(FRAME.rotation, turned), FRAME.tool)
    return Pose(upright.x_mm, upright.y_mm, upright.z_mm, *q)


def apart_deg(one, other):
    dot = abs(sum(a * b for a, b in zip(one.quaternion, other.quaternion, strict=True)))
    return math.degrees(2.0 * math.acos(min(1.0, dot)))


def guided(lean_deg):
    """An arm that stands there, ten datagrams after guidance has begun, and how to play more of them."""
    arm, wire = EgmArm(Settings(), Limits(), Ramps(), FRAME), Wire()
    arm._socket, arm._robot, arm._post = wire, ("127.0.0.1", 6510), lambda _event: None
    number = itertools.count()

    def cycles(count):
        """Each finds the arm where it was sent last."""
        for _ in range(count):
            at = next(number)
            feedback = wire.sent[-1] if wire.sent else leaning(lean_deg)
            arm._on_datagram(codec.encode_robot(codec.RobotState(at, 4 * at, feedback)), CYCLE_S * at)
        return wire.sent[-count:]

    assert len(cycles(10)) == 10, "each datagram is answered"
    return arm, cycles


def test_no_tool_is_turned_before_the_first_move_nor_by_a_hold():
    arm, cycles = guided(1.9)
    arm.hold("slip", stop=False)
    for answer in cycles(10):
        assert apart_deg(answer, leaning(1.9)) < 1e-5
        assert answer.z_mm == pytest.approx(leaning(1.9).z_mm, abs=1e-9)


def test_the_first_moves_right_the_tool_slowly_and_only_while_they_last():
    arm, cycles = guided(1.9)
    arm.move(HERE.at_height(61.0), "travel")
    short = cycles(100)
    turns = [apart_deg(a, b) for a, b in itertools.pairwise(short)]
    assert max(turns) == pytest.approx(RIGHTING_DEG_S * CYCLE_S, rel=0.01)
    rest_deg = apart_deg(short[-1], leaning(0.0))
    assert 0.1 < rest_deg < 1.8, "what is left waits for the next move"
    assert turns[-1] < 1e-6
    arm.move(HERE.at_height(70.0), "travel")
    end = cycles(200)[-1]
    assert end == FRAME.to_controller(HERE.at_height(70.0))


@pytest.mark.parametrize("elapsed_s", [0.012, 1.0])
def test_a_gap_turns_the_tool_no_further_than_three_cycles(elapsed_s):
    righting = Righting.of(FRAME, leaning(1.9), HERE)
    righting.go_on(elapsed_s)
    assert apart_deg(righting.pose(HERE), leaning(0.0)) == pytest.approx(1.9 - 3.0 * RIGHTING_DEG_S * CYCLE_S, abs=1e-3)
