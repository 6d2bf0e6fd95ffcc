"""Two sockets to one robot: a message on one may arrive after a later message on the other."""

import asyncio
import math

import pytest

from robot_client.insertion.events import Arrived, Standstill
from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.limits import LimitError, Limits
from robot_client.insertion.motion import Ramp, Ramps
from robot_client.robots.abb_rapid import codec, driver
from robot_client.robots.abb_rapid.driver import SocketArm
from robot_client.robots.abb_rapid.settings import Settings
from tests.robot_client.clock import stopped_clock


class Writer:
    """Stands in for a connection; keeps written data."""

    def __init__(self):
        self.sent = []

    def write(self, data):
        self.sent.append(data.decode())

    def is_closing(self):
        return False


@pytest.fixture
def clock(monkeypatch):
    return stopped_clock(monkeypatch, driver)


def guard_says(arm, number, *, stopped, z_mm=40.0, turned="0 1 0 0"):
    arm._on_guard(f"P {number} 5.00 0.00 {z_mm:.2f} {turned} {int(stopped)}")


def guided():
    arm, events = SocketArm(Settings(), Limits(), Ramps()), []
    arm._motion, arm._guard, arm._post = Writer(), Writer(), events.append
    guard_says(arm, 0, stopped=True)
    return arm, events


def rests(arm, clock, number):
    for _ in range(20):
        clock.now_s += 0.05
        guard_says(arm, number, stopped=True)


@pytest.mark.parametrize("answer", ["S 1", "D 1"])
def test_an_arm_stands_still_only_once_the_motion_server_has_answered_for_the_move(clock, answer):
    arm, events = guided()
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
    arm, events = guided()
    arm.move(WorkPose(x_mm=5.0, y_mm=0.0, z_mm=10.0, yaw_deg=0.0), "descend", 1e9)
    arm.hold("slip", stop=False)
    rests(arm, clock, 2)
    assert [type(event) for event in events] == [Standstill]
    assert events[0].still_s > 0.1


def over(answers, *, yaw_deg=0.0):
    """Events of an arm that is held and then found at these heights, each 0.05 s after the one before."""

    def story(clock):
        arm, events = guided()
        arm.hold("slip", stop=False)
        for height_mm in answers:
            clock.now_s += 0.05
            half = math.radians(180.0) / 2.0
            w, x = math.cos(half), math.sin(half)
            turned = math.radians(yaw_deg * (height_mm - 40.0)) / 2.0
            q = f"{w:.5f} {x * math.cos(turned):.5f} {x * math.sin(turned):.5f} 0"
            arm._on_guard(f"P 1 5.00 0.00 {height_mm:.2f} {q} 1")
        return events

    return story


@pytest.mark.parametrize(("step_mm", "stands"), [(0.01, True), (0.02, True), (0.04, False), (0.1, False)])
def test_an_arm_that_still_creeps_does_not_stand(clock, step_mm, stands):
    """To and fro by that much at each answer; the guard answers in hundredths of a millimetre."""
    assert bool(over([40.0 + step_mm * (k % 2) for k in range(12)])(clock)) == stands


@pytest.mark.parametrize(("answers_n", "stands"), [(3, False), (5, True)])
def test_an_arm_stands_once_it_has_rested_for_three_answers(clock, answers_n, stands):
    """0.15 s at 20 answers per second, starting with the first one."""
    events = over([40.0] * answers_n)(clock)
    assert [type(event) for event in events] == [Standstill] * stands


@pytest.mark.parametrize(("turn_deg", "stands"), [(2.0, True), (8.0, False)])
def test_an_arm_that_still_turns_does_not_stand(clock, turn_deg, stands):
    """By 0.02 deg at each answer, or by 0.08."""
    events = over([40.0 + 0.01 * (k % 2) for k in range(12)], yaw_deg=turn_deg)(clock)
    assert bool(events) == stands


@pytest.mark.parametrize(
    ("answer", "code"),
    [("E 1 speed", "refused"), ("S 1", "guard"), ("nonsense", "protocol"), ("E 7 speed", "refused"), ("S 7", "")],
)
def test_what_the_motion_server_answers_in_a_move_ends_it_where_that_is_no_arrival(clock, answer, code):
    arm, events = guided()
    arm.move(WorkPose(x_mm=5.0, y_mm=0.0, z_mm=45.0, yaw_deg=0.0), "travel")
    guard_says(arm, 1, stopped=False)
    arm._on_motion(answer)
    assert [event.code for event in events] == ([code] if code else [])
    assert (arm._guard.sent[-1][0] == "S") == bool(code), "the guard is asked to stop"
    arm._on_motion(answer)
    assert len(events) == len([code] if code else []), "reported once"


def test_an_arrival_is_reported_with_the_position_that_was_asked_for_after_it(clock):
    arm, events = guided()
    arm.move(WorkPose(x_mm=5.0, y_mm=0.0, z_mm=45.0, yaw_deg=0.0), "travel")
    guard_says(arm, 1, stopped=True)
    assert arm._motion.sent == [], "the flag is still up"
    guard_says(arm, 9, stopped=False)
    assert arm._motion.sent == [], "an answer to something else"
    guard_says(arm, 1, stopped=False)
    assert arm._motion.sent == ["M 1 5.00 0.00 45.00 0.00000 1.00000 0.00000 0.00000 80.0#"]
    arm._on_motion("D 1")
    assert arm._guard.sent == ["R 1#", "H 2#"]
    guard_says(arm, 1, stopped=False)
    assert events == []
    for number in (2, 3, 4):
        guard_says(arm, number, stopped=False, z_mm=45.0)
        clock.now_s += 0.1
    assert [type(event) for event in events] == [Arrived]
    guard_says(arm, 5, stopped=False, z_mm=45.0)
    assert len(events) == 1


@pytest.mark.parametrize(
    ("heights_mm", "turned", "ends"),
    [
        ((43.0, 44.5, 45.0), "0 1 0 0", "arrived"),  # what the guard reads comes to rest after the arm
        ((44.1,), "0 1 0 0", "arrived"),
        ((43.9,), "0 1 0 0", "tracking"),
        ((45.0,), "0 0.99997 0.00785 0", "arrived"),  # by 0.9 deg
        ((45.0,), "0 0.99995 0.01000 0", "tracking"),  # by 1.1 deg
        ((40.0,), "0 1 0 0", "tracking"),  # it never left
    ],
)
def test_a_move_that_is_said_to_be_done_elsewhere_is_a_failure(clock, heights_mm, turned, ends):
    """After an arrival the arm may go sideways."""
    arm, events = guided()
    arm.move(WorkPose(x_mm=5.0, y_mm=0.0, z_mm=45.0, yaw_deg=0.0), "retract")
    guard_says(arm, 1, stopped=False)
    arm._on_motion("D 1")
    for z_mm in (*heights_mm, heights_mm[-1]):
        assert events == []
        guard_says(arm, 2, stopped=False, z_mm=z_mm, turned=turned)
        clock.now_s += 0.2
    (event,) = events
    assert getattr(event, "code", event.kind) == ends
    assert (arm._guard.sent[-1][0] == "S") == (ends == "tracking")


def test_a_failure_latches_and_nothing_is_sent_off_any_more(clock):
    arm, events = guided()
    arm.move(WorkPose(x_mm=5.0, y_mm=0.0, z_mm=45.0, yaw_deg=0.0), "travel")
    arm._on_guard("P 1 5.00 0.00 40.00 0.05 0.99875 0 0 0")
    assert [event.code for event in events] == ["tilt"]
    guard_says(arm, 1, stopped=False)
    assert arm._motion.sent == []
    with pytest.raises(LimitError, match="takes no motion: tilt"):
        arm.move(WorkPose(x_mm=5.0, y_mm=0.0, z_mm=45.0, yaw_deg=0.0), "travel")


@pytest.mark.parametrize("half_tilt_deg", [0.9, 1.1])
def test_a_tool_may_tilt_by_two_degrees(clock, half_tilt_deg):
    arm, events = guided()
    half = math.radians(half_tilt_deg)
    arm._on_guard(f"P 1 5.00 0.00 40.00 {math.sin(half):.5f} {math.cos(half):.5f} 0 0 0")
    assert bool(events) == (half_tilt_deg > 1.0)


def test_requests_are_numbered_from_one_again_before_a_rapid_string_is_too_short():
    arm, _ = guided()
    arm._number = codec.MAX_NUMBER - 1
    assert [arm._next(), arm._next(), arm._next()] == [codec.MAX_NUMBER, 1, 2]
    assert codec.MAX_NUMBER > 50_000
    longest = codec.Pose(-999.99, -999.99, -999.99, -0.5, -0.5, -0.5, -0.5)
    assert len(codec.encode_move(codec.MAX_NUMBER, longest, 999.0)) <= 80


def test_legs_and_speeds_beyond_the_limits_are_refused(clock):
    arm, _ = guided()
    low = WorkPose(x_mm=5.0, y_mm=0.0, z_mm=20.0, yaw_deg=0.0)
    with pytest.raises(LimitError, match="one speed"):
        arm.move(low, "descend", 1e9, ((20.0, 5.0),))
    arm.ramps = Ramps(descend=Ramp(speed_mm_s=15.5, acceleration_mm_s2=100.0, jerk_mm_s3=1000.0))
    with pytest.raises(LimitError, match=r"descend speed mm/s = 15.5, allowed up to 15"):
        arm.move(low, "descend", 1e9)
    assert arm._guard.sent == []


def test_an_order_to_stop_latches_the_arm_with_its_first_reason_and_a_hold_does_not(clock):
    arm, _ = guided()
    up = WorkPose(x_mm=5.0, y_mm=0.0, z_mm=45.0, yaw_deg=0.0)
    arm.hold("slip", stop=False)
    arm.move(up, "travel")
    for reason in ("operator: stop", "again"):
        arm.hold(reason, stop=True)
        with pytest.raises(LimitError, match="takes no motion: operator: stop"):
            arm.move(up, "travel")
    assert [text[0] for text in arm._guard.sent] == ["S", "R", "S", "S"]


def test_only_the_first_of_several_failures_is_reported_and_no_arrival_after_it(clock):
    arm, events = guided()
    arm.move(WorkPose(x_mm=5.0, y_mm=0.0, z_mm=45.0, yaw_deg=0.0), "travel")
    guard_says(arm, 1, stopped=False)
    arm._on_motion("D 1")
    arm._fail("silent", "no answer")
    arm._fail("link", "and then gone")
    guard_says(arm, 2, stopped=False)
    assert [event.code for event in events] == ["silent"]


def test_a_standstill_is_waited_for_anew_after_each_hold_and_said_once(clock):
    arm, events = guided()
    for _ in range(2):
        arm.hold("slip", stop=False)
        guard_says(arm, 2, stopped=True)
        clock.now_s += 0.1
        guard_says(arm, 2, stopped=False)
        clock.now_s += 0.06
        guard_says(arm, 2, stopped=False)
        assert events == [], "the guard's flag is not up yet"
        guard_says(arm, 2, stopped=True)
        clock.now_s += 0.5
        guard_says(arm, 2, stopped=True)
        assert [type(event) for event in events] == [Standstill]
        guard_says(arm, 2, stopped=True)
        assert len(events) == 1
        events.clear()
        clock.now_s += 5.0


async def test_an_arm_that_was_never_started_knows_nothing_moves_nothing_and_closes():
    arm = SocketArm(Settings(), Limits(), Ramps())
    assert (arm.position(), arm.target(), arm.signals(), arm.statistics()) == (None, None, None, {"guard_answers": 0})
    with pytest.raises(LimitError, match="not started"):
        arm.move(WorkPose(x_mm=5.0, y_mm=0.0, z_mm=45.0, yaw_deg=0.0), "travel")
    (finding,) = await arm.checks()["guidance"]()
    assert list(arm.checks()) == ["guidance"]
    assert (finding.good, "192.168.125.1:5010 and :5011" in finding.text) == (True, True)
    assert await arm.close() == "guard stopped the arm; no program was started"


def test_what_the_guard_says_counts_and_what_is_no_answer_of_its_does_not(clock):
    arm, events = guided()
    before = arm.position()
    for text in ("P 1 5.00 0.00 nonsense", "P 1 5.00 0.00 41.00 0 0.5 0 0 0", "?"):
        arm._on_guard(text)
    assert (arm.position(), arm.statistics(), events) == (before, {"guard_answers": 1}, [])
    guard_says(arm, 2, stopped=False)
    assert arm.statistics() == {"guard_answers": 2}


async def test_a_defect_of_ours_in_handling_an_answer_is_a_failure_at_once_and_not_a_silence(clock):
    arm, events = guided()
    reader = asyncio.StreamReader()
    reader.feed_data(b"P 1 5 0 40 0 1 0 0 1#")
    with pytest.raises(ZeroDivisionError):
        await arm._read(reader, lambda _text: 1 / 0, "guard")
    assert [(event.code, event.detail) for event in events] == [("internal", "ZeroDivisionError: division by zero")]
    assert arm._guard.sent[-1][0] == "S"


def test_a_guard_that_hangs_up_is_asked_nothing_any_more(clock):
    arm, _ = guided()
    arm._guard.is_closing = lambda: True
    arm.hold("slip", stop=False)
    assert arm._guard.sent == []
