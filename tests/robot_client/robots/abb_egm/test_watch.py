"""The stream's health: order, repetition, age, readiness."""

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from robot_client.insertion.geometry import Pose
from robot_client.robots.abb_egm.codec import RobotState
from robot_client.robots.abb_egm.watch import EgmWatch, StreamFault
from robot_client.silence import Silence


def watch():
    return EgmWatch(Silence(0.25, 0.05), 0.25)


def state(sequence, time_ms, **changes):
    return RobotState(sequence, time_ms, Pose(0, 0, 0), **changes)


def test_a_stream_that_falls_behind_is_stale():
    w = watch()
    for i in range(100):
        w.take(state(i, 4 * i), 0.004 * i)
    w.check(state(99, 396))
    w.take(state(100, 400), 0.4 + 0.3)
    with pytest.raises(StreamFault, match="late"):
        w.check(state(100, 400))
    assert w.statistics()["worst_age_ms"] == pytest.approx(300.0)


def test_a_controller_that_was_long_not_ready_is_not_late_once_it_is():
    w = watch()
    for i in range(1000):
        assert w.take(state(5000 + i, 4 * i, motors_on=False), 0.004 * i) is not None
        assert not w.ready(state(5000 + i, 4 * i, motors_on=False))
    for i in range(100):
        assert w.take(state(i, 4 * i), 4.0 + 0.004 * i) is not None
        assert w.ready(state(i, 4 * i))
        w.check(state(i, 4 * i))


def test_an_hour_of_clock_drift_is_not_lateness():
    w = watch()
    for i in range(3600):
        w.take(state(250 * i, 1000 * i), i * 1.0001)
        w.check(state(250 * i, 1000 * i))


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


CLOCK = st.integers(0, 2**32 - 1)
ANY_STEP = st.integers(-(2**31), 2**31 - 1)


@given(CLOCK, ANY_STEP)
@example(0, 1)
@example(7, 2**31 - 1)
@example(7, -(2**31))
def test_a_datagram_is_newer_if_it_is_less_than_half_a_round_ahead(sequence, ahead):
    w = watch()
    w.take(state(sequence, 0), 0.0)
    taken = w.take(state((sequence + ahead) % 2**32, 4), 0.004)
    assert (taken is not None) == (ahead > 0)
    assert w.repeated == (ahead <= 0)


@given(CLOCK, ANY_STEP)
@example(0, 2**31 - 1)
@example(0, -(2**31))
@example(5, 1)
def test_time_goes_on_by_what_the_robots_clock_says_however_often_it_has_wrapped_and_never_back(time_ms, step_ms):
    w = watch()
    assert w.take(state(1, time_ms), 0.0) == 0.0
    assert w.take(state(2, (time_ms + step_ms) % 2**32), 0.004) == pytest.approx(max(0, step_ms) / 1000.0)


def test_a_stream_that_nobody_has_heard_counts_nothing():
    assert set(watch().statistics().values()) == {0}


@pytest.mark.parametrize(("gap_s", "gaps"), [(0.013, 0), (0.015, 1)])
def test_three_cycles_may_pass_between_datagrams_before_that_is_a_gap(gap_s, gaps):
    w = watch()
    for number, now_s in enumerate((0.0, 0.004, 0.004 + gap_s)):
        w.take(state(number, round(1e3 * now_s)), now_s)
    assert w.statistics()["gaps"] == gaps
    assert w.statistics()["worst_gap_ms"] == pytest.approx(1e3 * gap_s * gaps)


def test_the_worst_times_are_told_in_tenths_of_a_millisecond():
    w = watch()
    for number, now_s in enumerate((0.0, 0.10026)):
        w.take(state(number, 4 * number), now_s)
    assert (w.statistics()["worst_gap_ms"], w.statistics()["worst_age_ms"]) == (100.3, 96.3)


def test_a_stream_that_falls_behind_a_little_at_a_time_is_late_in_the_end():
    """By a hundredth of the time, which no quartz clock does: 0.25 s after half a minute."""
    w = watch()
    for i in range(20):
        w.take(state(250 * i, 1000 * i), 1.01 * i)
        w.check(state(250 * i, 1000 * i))
    for i in range(20, 40):
        w.take(state(250 * i, 1000 * i), 1.01 * i)
    with pytest.raises(StreamFault, match="late"):
        w.check(state(40, 0))


@pytest.mark.parametrize("before_n", [0, 30])
@pytest.mark.parametrize(("unreadable_n", "why"), [(24, "silent or frozen"), (25, "only unreadable ones came")])
def test_why_no_datagram_counts_is_told_by_what_came_since_the_last_good_one(unreadable_n, why, before_n):
    w = watch()
    for _ in range(before_n):
        w.bad("noise")
    if before_n:
        w.take(state(1, 4), 0.0)
    else:  # none has come yet
        w.silence.heard(0.0)
    for _ in range(unreadable_n):
        w.bad("noise")
    for now_s in (0.1, 0.2, 0.25):
        w.check_silence(now_s)
    with pytest.raises(StreamFault, match=f"no new datagram for 260 ms: .*{why}"):
        w.check_silence(0.26)
    assert w.bad_datagrams == before_n + unreadable_n


@pytest.mark.parametrize(("cycle_ms", "lost_n", "slow"), [(4, 0, False), (12, 0, False), (16, 0, True), (4, 5, False)])
def test_a_controller_that_sends_too_seldom_is_named_and_lost_datagrams_are_no_slower_controller(
    cycle_ms, lost_n, slow
):
    """Guided every 24 ms, an arm would walk at half its speed."""
    w = watch()
    newest = [state(i, cycle_ms * i) for i in range(0, 40 * (1 + lost_n), 1 + lost_n)]
    for one in newest:
        w.take(one, one.time_ms / 1e3)
    if slow:
        with pytest.raises(
            StreamFault, match=f"slow: the controller sends every {cycle_ms} ms, expected 4, 12 at most"
        ):
            w.check(newest[-1])
    else:
        w.check(newest[-1])


def test_a_controller_that_is_late_for_a_moment_is_not_a_slow_one():
    w, time_ms = watch(), 0
    for i in range(100):
        time_ms += 24 if i % 25 else 4
        w.take(state(i, time_ms), time_ms / 1e3)
        w.check(state(i, time_ms))
