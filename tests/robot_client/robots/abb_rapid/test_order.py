"""Two sockets to one robot: what was said on one may arrive after what was said later on the other."""

import pytest

from robot_client.insertion.events import Standstill
from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.limits import Limits
from robot_client.insertion.motion import Ramps
from robot_client.robots.abb_rapid import driver
from robot_client.robots.abb_rapid.driver import SocketArm
from robot_client.robots.abb_rapid.settings import Settings
from tests.robot_client.clock import stopped_clock


class Writer:
    """Stands for a connection; keeps what is written."""

    def __init__(self):
        self.sent = []

    def write(self, data):
        self.sent.append(data.decode())

    def is_closing(self):
        return False


@pytest.fixture
def clock(monkeypatch):
    return stopped_clock(monkeypatch, driver)


def guard_says(arm, number, *, stopped):
    arm._on_guard(f"P {number} 5.00 0.00 40.00 0 1 0 0 0 {int(stopped)}")


def rests(arm, clock, number):
    for _ in range(20):
        clock.now_s += 0.05
        guard_says(arm, number, stopped=True)


@pytest.mark.parametrize("answer", ["S 1", "D 1"])
def test_an_arm_stands_still_only_once_the_motion_server_has_answered_for_the_move(clock, answer):
    arm, events = SocketArm(Settings(), Limits(), Ramps()), []
    arm._motion, arm._guard, arm._post = Writer(), Writer(), events.append
    guard_says(arm, 0, stopped=True)
    arm.move(WorkPose(x_mm=5.0, y_mm=0.0, z_mm=10.0, yaw_deg=0.0), "descend", 1e9)
    guard_says(arm, 1, stopped=False)
    assert arm._motion.sent[0].startswith("M 1 ")
    arm.hold("slip", stop=False)
    rests(arm, clock, 2)
    assert events == [], "the move may still lie in the network, and the next release would set it going"
    arm._on_motion(answer)
    rests(arm, clock, 2)
    assert [type(event) for event in events] == [Standstill]


def test_an_arm_that_was_never_sent_off_stands_still_at_once(clock):
    arm, events = SocketArm(Settings(), Limits(), Ramps()), []
    arm._motion, arm._guard, arm._post = Writer(), Writer(), events.append
    guard_says(arm, 0, stopped=True)
    arm.move(WorkPose(x_mm=5.0, y_mm=0.0, z_mm=10.0, yaw_deg=0.0), "descend", 1e9)
    arm.hold("slip", stop=False)
    rests(arm, clock, 2)
    assert [type(event) for event in events] == [Standstill]
    assert events[0].still_s > 0.1
