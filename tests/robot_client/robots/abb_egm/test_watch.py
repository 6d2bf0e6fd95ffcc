"""The stream's health: order, repetition, age, readiness."""

import pytest

from robot_client.insertion.geometry import Pose
from robot_client.robots.abb_egm.codec import RobotState
from robot_client.robots.abb_egm.watch import EgmWatch, StreamFault
from robot_client.silence import Silence


def watch():
    return EgmWatch(Silence(0.25, 0.05), 0.25)


def state(sequence, time_ms, **changes):
    return RobotState(sequence, time_ms, Pose(0, 0, 0), **changes)


def test_repeated_and_late_datagrams_are_not_taken():
    w = watch()
    assert w.take(state(5, 100), 0.0) == 0.0
    assert w.take(state(5, 100), 0.004) is None
    assert w.take(state(4, 96), 0.005) is None
    assert w.take(state(7, 108), 0.008) == pytest.approx(0.008)
    assert w.repeated == 2


def test_sequence_and_clock_may_wrap():
    w = watch()
    w.take(state(2**32 - 1, 2**32 - 2), 0.0)
    assert w.take(state(0, 2), 0.004) == pytest.approx(0.004)


def test_a_stream_that_falls_behind_is_stale():
    w = watch()
    for i in range(100):
        w.take(state(i, 4 * i), 0.004 * i)
    w.check(state(99, 396))
    w.take(state(100, 400), 0.4 + 0.3)
    with pytest.raises(StreamFault, match="late"):
        w.check(state(100, 400))
    assert w.statistics()["worst_age_ms"] == pytest.approx(300.0)


def test_an_hour_of_clock_drift_is_not_lateness():
    w = watch()
    for i in range(3600):
        w.take(state(i, 1000 * i), i * 1.0001)
        w.check(state(i, 1000 * i))


@pytest.mark.parametrize(
    ("changes", "expect"),
    [
        ({"motors_on": False}, "motors"),
        ({"rapid_running": False}, "RAPID"),
        ({"mc_state": "error"}, "EGM error"),
        ({"collided": True}, "collision"),
    ],
)
def test_a_controller_that_does_not_follow_is_named(changes, expect):
    w = watch()
    assert w.ready(state(1, 4))
    assert not w.ready(state(1, 4, **changes))
    assert expect in w.not_ready
    with pytest.raises(StreamFault, match=expect):
        w.check(state(1, 4, **changes))


def test_datagrams_are_not_late_because_the_robots_clock_wrapped():
    w = watch()
    for i in range(10):
        newest = state(i, (2**32 - 20 + 4 * i) % 2**32)
        w.take(newest, 0.004 * i)
        w.check(newest)


def test_a_robots_clock_that_steps_back_takes_no_way_and_hides_no_lateness():
    w = watch()
    for i in range(100):
        w.take(state(i, 1000 + 4 * i), 0.004 * i)
    assert w.take(state(100, 1000), 0.4) == 0.0
    with pytest.raises(StreamFault, match="late"):
        w.check(state(100, 1000))


def test_what_the_stream_was_like_is_counted():
    w = watch()
    for at_s, sequence in ((0.0, 1), (0.004, 2), (0.104, 3), (0.108, 4), (0.148, 5)):
        w.take(state(sequence, round(1000 * at_s)), at_s)
    w.bad("no datagram")
    w.bad("no datagram")
    assert (w.bad_datagrams, w.gaps, w.repeated) == (2, 2, 0)
    assert w.worst_gap_s == pytest.approx(0.1)
    assert w.not_ready == "no datagram"
