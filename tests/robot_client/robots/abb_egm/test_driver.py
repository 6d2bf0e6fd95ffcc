"""The robot that is answered, and the first answer: the started robot, at its arm's present pose."""

import asyncio
import math

import pytest

from robot_client.insertion.geometry import CellFrame, WorkPose
from robot_client.insertion.limits import LimitError, Limits
from robot_client.insertion.motion import Ramps
from robot_client.ports import DriverError
from robot_client.robots.abb_egm import codec
from robot_client.robots.abb_egm.driver import EgmArm
from robot_client.robots.abb_egm.settings import Settings
from robot_client.settings import load_settings


class Wire:
    """Stands in for the UDP socket; keeps sent data."""

    def __init__(self):
        self.sent = []

    def sendto(self, datagram, _address):
        self.sent.append(codec.decode_guidance(datagram).pose)


def answers_to(tilt_deg):
    """Answers to ten datagrams of a resting arm with a tilted tool, and the reported failure."""
    half = math.radians(180.0 - tilt_deg) / 2.0
    measured = codec.Pose(5.0, 0.0, 60.0, math.cos(half), math.sin(half), 0.0, 0.0)
    arm, wire = EgmArm(Settings(), Limits(), Ramps()), Wire()
    arm._socket, arm._robot = wire, ("127.0.0.1", 6510)
    for number in range(10):
        datagram = codec.encode_robot(codec.RobotState(number, 4 * number, measured))
        arm._on_datagram(datagram, 0.004 * number)
    return wire.sent, arm._watch.not_ready


def test_an_arm_that_hangs_upright_is_held_where_it_stands():
    sent, _ = answers_to(0.0)
    assert len(sent) == 10
    for pose in sent:
        here, tilt_deg = CellFrame().from_controller(pose)
        assert (here.distance_mm(WorkPose(x_mm=5.0, y_mm=0.0, z_mm=60.0, yaw_deg=0.0)), tilt_deg) == (0.0, 0.0)


def test_a_tilted_arm_is_never_answered_since_every_target_would_turn_it_upright():
    sent, reason = answers_to(25.0)
    assert sent == []
    assert "tilted by 25.00 deg, allowed 2" in reason


@pytest.mark.parametrize(("tilt_deg", "held"), [(0.0, False), (1.9, False), (2.1, True), (25.0, True)])
def test_a_guided_arm_takes_no_motion_once_its_tool_tilts_beyond_the_limit(tilt_deg, held):
    async def story():
        arm, posted = EgmArm(Settings(), Limits(), Ramps()), []
        arm._socket, arm._robot, arm._post = Wire(), ("127.0.0.1", 6510), posted.append
        for number, tilt in enumerate((0.0, tilt_deg)):
            half = math.radians(180.0 - tilt) / 2.0
            measured = codec.Pose(5.0, 0.0, 60.0, math.cos(half), math.sin(half), 0.0, 0.0)
            arm._on_datagram(codec.encode_robot(codec.RobotState(number, 4 * number, measured)), 0.004 * number)
            arm._timer = arm._timer or asyncio.get_running_loop().call_later(60.0, print)
        arm._timer.cancel()
        try:
            arm.move(WorkPose(x_mm=5.0, y_mm=0.0, z_mm=65.0, yaw_deg=0.0), "travel")
            return ""
        except LimitError as error:
            return str(error)

    refused = asyncio.run(story())
    assert bool(refused) == held
    assert not held or f"tilted by {tilt_deg:.2f} deg, allowed 2" in refused


@pytest.mark.parametrize("url", ["http://127.0.0.1:8", "http://localhost:8"])
def test_only_the_robot_whose_program_is_started_is_guided(url):
    async def story():
        settings = load_settings(None, {"robot": {"rws": {"url": url}}})
        arm = settings.make_arm()
        assert not arm._is_robot(("192.0.2.7", 6510)), "another robot that sends to the same port"
        assert arm._is_robot(("127.0.0.1", 6510))
        await arm.rws._client.aclose()

    asyncio.run(story())


def test_datagrams_of_another_host_are_named_as_such():
    async def story():
        arm = EgmArm(
            Settings(bind="127.0.0.1", port=0, robot_host="192.0.2.7", ready_timeout_s=0.05), Limits(), Ramps()
        )
        arm._foreign = 3
        with pytest.raises(DriverError, match=r"3 datagrams came, none from 192\.0\.2\.7"):
            await arm.start(lambda _event: None)
        await arm.close()

    asyncio.run(story())
