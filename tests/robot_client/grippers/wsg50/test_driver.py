"""What keeps the watch over a grasp alive: the grasping state itself, not whatever else comes from the gripper."""

import pytest

from robot_client.grippers.wsg50 import codec, driver, text_driver
from robot_client.grippers.wsg50.codec import Command, GraspingState, Status
from robot_client.grippers.wsg50.driver import Wsg50, WsgSettings
from robot_client.grippers.wsg50.text_driver import GclGripper
from tests.robot_client.clock import stopped_clock


@pytest.fixture
def clock(monkeypatch):
    return stopped_clock(monkeypatch, driver, text_driver)


def told(gripper, *frame):
    for whole in gripper._parser.feed(codec.encode_reply(*frame)):
        gripper._route(whole)


@pytest.mark.parametrize(
    "frame", [(Command.GRASPING_STATE, Status.NOT_AVAILABLE), (Command.WIDTH, Status.SUCCESS, 50.0)]
)
def test_frames_that_tell_no_grasping_state_are_silence(clock, frame):
    gripper = Wsg50(WsgSettings())
    told(gripper, Command.GRASPING_STATE, Status.SUCCESS, int(GraspingState.HOLDING))
    for _ in range(10):
        clock.now_s += 0.1
        told(gripper, *frame)
        silent_s = gripper._silence.over(clock.now_s)
    assert silent_s == pytest.approx(1.0)


def test_a_width_in_text_is_no_grasping_state(clock):
    gripper = GclGripper(WsgSettings())
    gripper._on_line("@GRIPSTATE=4")
    for _ in range(10):
        clock.now_s += 0.1
        gripper._on_line("@POS=50.0")
        silent_s = gripper._silence.over(clock.now_s)
    assert silent_s == pytest.approx(1.0)
