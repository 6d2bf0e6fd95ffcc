"""The motion lease: the arm continues only on judged frames."""

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_client.insertion.actions import MOST_STOOD_S
from robot_client.insertion.events import Move, Renew, Stood, Tick
from robot_client.insertion.lease import PAUSE_S, ClockMap, Lease, Unwatched
from robot_client.insertion.limits import LimitError, Limits
from robot_client.insertion.machine import Phase, State, step
from robot_client.insertion.motion import CYCLE_S, MotionGuide, Ramps
from service.contract import wire
from tests.robot_client.insertion.stories import (
    APPROACH,
    ID,
    PLAN,
    TO_ARMING,
    TO_DESCENT,
    armed,
    held,
    hello,
    run,
    service,
    watching,
)

LASTS_S = PLAN.lease.lasts_s(10.0)


def descending(pause_s=0.0):
    return run(TO_DESCENT, State(PLAN.model_copy(update={"pause_s": pause_s})))


@pytest.mark.parametrize(("speed_mm_s", "travel_mm"), [(5.0, 1.5), (15.0, 1.5), (25.0, 2.5), (60.0, 4.0)])
def test_the_travel_without_a_judged_frame_is_limited_by_the_speed(speed_mm_s, travel_mm):
    assert Lease(travel_mm=4.0).at_most(speed_mm_s).travel_mm == pytest.approx(travel_mm)


def test_a_descent_carries_the_end_of_its_lease_and_every_judged_frame_puts_it_off():
    state, commands = descending()
    (move,) = [c for c in commands if isinstance(c, Move) and c.motion == "descend"]
    assert move.until_s == pytest.approx(LASTS_S)
    state, (renewed,) = step(state, service(watching(1, 0.05), 0.07))
    assert isinstance(renewed, Renew)
    assert renewed.until_s == pytest.approx(0.05 + LASTS_S, abs=1e-4)


@pytest.mark.parametrize("pause_s", [0.0, PAUSE_S])
def test_without_a_judged_frame_the_descent_ends_whatever_else_the_service_says(pause_s):
    """An arm that cannot stop and go on is held at the end of the lease, by whichever side notices first."""
    state, _ = descending(pause_s)
    beat = wire.ServiceHeartbeat(insertion_id=ID, count=1, clock=wire.Clock(sent_ns=0, service_ns=0), frame_age_ms=1.0)
    for now_s in (0.03, 0.06, 0.09):
        state, commands = step(state, service(beat, now_s))
        assert (state.phase, commands) == (Phase.DESCENDING, ())
    state, commands = step(state, Tick(at_s=LASTS_S + pause_s - 0.001))
    assert (state.phase, commands) == (Phase.DESCENDING, ())
    state, commands = step(state, Tick(at_s=LASTS_S + pause_s + 0.001))
    assert held(state, commands)
    assert commands[1].message.cause == "unwatched"


@pytest.mark.parametrize("captured_s", [-0.5, 0.0, 7.0])
def test_a_frame_that_comes_late_or_twice_or_from_the_future_renews_nothing(captured_s):
    state, _ = descending()
    after, commands = step(state, service(watching(1, captured_s), 0.05))
    assert (after, commands) == (state, ())


@pytest.mark.parametrize(("pause_s", "late_s"), [(0.0, 0.005), (PAUSE_S, PAUSE_S + 0.01)])
def test_a_lease_that_ended_too_long_ago_is_not_renewed_by_a_fresh_frame(pause_s, late_s):
    state, _ = descending(pause_s)
    late_s += LASTS_S
    assert held(*step(state, service(watching(1, late_s - 0.01), late_s)))


def test_a_frame_that_is_judged_within_the_pause_renews_the_lease():
    state, _ = descending(PAUSE_S)
    late_s = LASTS_S + 0.1
    state, (renewed, paused) = step(state, service(watching(1, late_s - 0.02), late_s))
    assert state.phase is Phase.DESCENDING
    assert renewed.until_s > late_s
    assert (paused.message.type, paused.message.speed_mm_s) == ("descending", state.speed_mm_s)
    assert paused.message.paused_s == pytest.approx(0.1)
    _, (renewed,) = step(state, service(watching(1, late_s), late_s + 0.01))
    assert isinstance(renewed, Renew), "without a pause there is nothing to say"


def test_frames_that_come_all_at_once_after_a_stall_count_the_pause_once():
    """Each is newer than the one before, but only the last lets the arm go on: it stood for 0.2 s, not for 0.7 s."""
    state, _ = descending(PAUSE_S)
    now_s, stood = LASTS_S + 0.2, state
    for captured_s in (0.033, 0.066, 0.1, 0.133, 0.166, 0.2):
        state, commands = step(state, service(watching(1, captured_s), now_s))
        assert (state, commands) == (stood, ())
    _, (renewed, paused) = step(state, service(watching(1, now_s - 0.01), now_s))
    assert renewed.until_s > now_s
    assert paused.message.paused_s == pytest.approx(0.2)


def test_frames_that_are_always_judged_too_late_do_not_keep_a_descent_waiting():
    state, _ = descending(PAUSE_S)
    for late_s in (0.05, 0.1, 0.15, 0.2):
        state, _ = step(state, service(watching(1, late_s - 0.01), LASTS_S + late_s))
    assert "unwatched" in held(*step(state, Tick(at_s=LASTS_S + PAUSE_S + 0.001)))


def test_an_arm_that_stood_for_longer_than_can_be_stated_goes_no_further():
    state, _ = descending(PAUSE_S)
    reason = held(*step(state, Stood(at_s=0.05, stood_s=MOST_STOOD_S + 0.01)))
    assert reason.startswith("arm: link: the descent stood for 1.01 s")


@pytest.mark.parametrize("stood_s", [0.19, MOST_STOOD_S])
def test_an_arm_that_stood_because_its_link_had_gaps_is_reported_like_a_pause(stood_s):
    """Else the service would take the time for travel, and the touch for as much deeper."""
    state, _ = descending(PAUSE_S)
    stood = Stood(at_s=0.05, stood_s=stood_s)
    after, (paused,) = step(state, stood)
    assert (after.phase, after.until_s) == (Phase.DESCENDING, state.until_s), "it renews nothing"
    assert (paused.message.type, paused.message.speed_mm_s, paused.message.paused_s) == ("descending", 10.0, stood_s)
    assert step(run(TO_DESCENT[:-1])[0], stood)[1] == ()


@pytest.mark.parametrize(("captured_s", "paused_n"), [(-0.01, 0), (0.04, 0), (0.06, 1)])
def test_a_stop_by_a_frame_that_shows_an_arm_that_already_stood_says_for_how_long(captured_s, paused_n):
    """A late order by a frame from before the pause tells nothing: its depth is right."""
    state, _ = descending(PAUSE_S)
    enough = wire.Enough(
        insertion_id=ID, attempt=1, frame_seq=3, captured_ns=round((LASTS_S + captured_s) * 1e9), pressed_mm=0.8
    )
    state, (first, *others) = step(state, service(enough, LASTS_S + 0.1))
    assert (state.phase, first.kind) == (Phase.STOPPING, "hold")
    assert [c.message.paused_s for c in others] == [pytest.approx(0.1)] * paused_n


def test_nothing_descends_before_the_clocks_are_mapped_or_on_an_old_reference():
    strange = [*TO_ARMING[:1], service(hello(clock=None)), *TO_ARMING[2:], service(armed(1))]
    old = [*TO_ARMING, service(armed(1), 0.5)]
    for story in (strange, old):
        state, commands = run(story)
        assert state.phase is Phase.ARMING
        assert not [c for c in commands if isinstance(c, Move) and c.motion == "descend"]
    state, commands = step(state, service(watching(1, 0.55), 0.56))
    assert (state.phase, commands[1].until_s) == (Phase.DESCENDING, pytest.approx(0.55 + LASTS_S, abs=1e-3))


@given(
    st.floats(-1e4, 1e4),
    st.lists(st.tuples(st.floats(0.0, 0.2), st.floats(0.0, 0.2), st.floats(0.01, 1.0)), min_size=1, max_size=20),
)
def test_no_stamp_is_ever_taken_for_younger_than_it_is(offset_s, trips):
    """Whatever the transit times, the mapped capture is not later than the true one."""
    now_s, mapped = 0.0, None
    for there_s, back_s, pause_s in trips:
        read = wire.Clock(sent_ns=round(now_s * 1e9), service_ns=round((now_s + there_s + offset_s) * 1e9))
        now_s += there_s + back_s
        taken = ClockMap.read(read, now_s)
        mapped = taken if mapped is None else mapped.narrowed(taken)
        assert mapped is not None
        truth_s = now_s
        assert mapped.ours_s(round((truth_s + offset_s) * 1e9), now_s) <= truth_s + 1e-5
        assert truth_s - mapped.ours_s(round((truth_s + offset_s) * 1e9), now_s) <= mapped.uncertainty_s + 1e-5
        now_s += pause_s


@given(st.floats(-1e4, 1e4), st.floats(0.0, 0.2), st.floats(0.0, 1e4))
def test_a_reading_combined_with_itself_is_that_reading(earliest_s, trip_s, at_s):
    read = ClockMap(earliest_s, earliest_s + trip_s, at_s)
    assert read.narrowed(read) == read


@pytest.mark.parametrize(("millionths", "holds"), [(100, True), (-100, True), (300, False), (-300, False)])
def test_two_quartz_clocks_may_drift_apart_by_a_hundred_millionths_and_not_by_three(millionths, holds):
    """Over 1,000 s, both read without any delay."""
    begun = ClockMap.read(wire.Clock(sent_ns=0, service_ns=0), 0.0)
    service_ns = 10**12 + millionths * 10**6
    later = ClockMap.read(wire.Clock(sent_ns=10**12, service_ns=service_ns), 1000.0)
    assert (begun.narrowed(later) is not None) == holds


def test_a_clock_that_stood_still_or_jumped_holds_the_arm():
    """A suspended client comes back with a clock behind: a frame from before would look young."""
    state, _ = descending()
    jumped = wire.Clock(sent_ns=10_000_000, service_ns=5_000_000_000)
    beat = wire.ServiceHeartbeat(insertion_id=ID, count=1, clock=jumped, frame_age_ms=1.0)
    assert "clock" in held(*step(state, service(beat, 0.02)))


@pytest.mark.parametrize(("speed_mm_s", "most_mm"), [(5.0, 1.5), (10.0, 1.5), (15.0, 1.5), (25.0, 2.5)])
def test_no_setting_makes_the_way_longer_than_the_bound(speed_mm_s, most_mm):
    Lease(travel_mm=most_mm).check(speed_mm_s)
    with pytest.raises(LimitError, match="travel_mm"):
        Lease(travel_mm=most_mm + 0.01).check(speed_mm_s)
    with pytest.raises(LimitError, match="stop lag"):
        Lease(travel_mm=most_mm, stop_lag_s=most_mm / speed_mm_s).check(speed_mm_s)


@pytest.mark.parametrize(
    ("rate_hz", "descends"), [(60.0, True), (30.0, True), (20.0, True), (15.0, False), (10.0, False)]
)
def test_cameras_too_slow_for_the_descent_are_refused_by_name(rate_hz, descends):
    camera = wire.CameraEntry(finger="right", source="s", state="live", frame_rate_hz=rate_hz)
    state, _ = run([TO_ARMING[0], service(hello(cameras=(camera,)))])
    assert (state.phase is Phase.GRASPING) == descends
    if not descends:
        assert "right camera" in state.reason
        slower = float(state.reason.split("descend at ")[1].split()[0])
        PLAN.lease.check_rate(slower - 0.05, camera)


def descend_until(until_s):
    """A guide whose lease has just ended in mid-descent, and the time that it is."""
    guide = MotionGuide(Limits(), Ramps(), APPROACH)
    guide.move(APPROACH.at_height(15.0), "descend", until_s=until_s)
    cycles = round(until_s / CYCLE_S)
    for n in range(1, cycles):
        guide.advance(CYCLE_S, n * CYCLE_S)
    return guide, cycles * CYCLE_S


def test_the_last_layer_lets_the_target_stand_when_the_lease_ends_even_if_nobody_tells_it():
    guide, now_s = descend_until(0.2)
    reached = guide.target
    while now_s < 0.2 + PAUSE_S - CYCLE_S / 2:
        assert guide.advance(CYCLE_S, now_s) == reached
        now_s += CYCLE_S
    with pytest.raises(Unwatched):
        guide.advance(CYCLE_S, now_s + CYCLE_S)
    assert guide.target == reached


def test_a_frame_that_is_judged_during_the_pause_lets_the_target_walk_on_from_rest():
    guide, now_s = descend_until(0.2)
    reached = guide.target
    guide.advance(CYCLE_S, now_s)
    guide.renew(now_s + 0.1)
    steps = [reached.z_mm]
    for _ in range(20):
        now_s += CYCLE_S
        steps.append(guide.advance(CYCLE_S, now_s).z_mm)
    ways = [high - low for high, low in pairwise(steps)]
    assert 0.0 < ways[0] < 0.1 * ways[-1], "from rest, on a ramp"
    assert guide.pauses_n == 1


def test_frames_that_are_always_judged_too_late_do_not_keep_a_pause_going():
    guide, now_s = descend_until(0.2)

    def blink():
        for n in range(round(2.0 * PAUSE_S / CYCLE_S)):
            guide.advance(CYCLE_S, now_s + n * CYCLE_S)
            guide.renew(now_s + (n - 0.5) * CYCLE_S)

    with pytest.raises(Unwatched):
        blink()


@pytest.mark.parametrize(("motion", "until_s"), [("descend", None), ("travel", 9.0)])
def test_a_descent_without_a_lease_is_refused(motion, until_s):
    guide = MotionGuide(Limits(), Ramps(), APPROACH)
    with pytest.raises(LimitError, match="lease"):
        guide.move(APPROACH.at_height(20.0), motion, until_s)
    assert not guide.moving


def test_a_hold_ends_the_lease_with_the_descent():
    guide = MotionGuide(Limits(), Ramps(), APPROACH)
    guide.move(APPROACH.at_height(15.0), "descend", until_s=0.2)
    guide.hold()
    assert guide.advance(CYCLE_S, 9.0) == APPROACH
    assert State(PLAN).until_s == -math.inf


@pytest.mark.parametrize(("expected_mm", "allowed"), [(6.1, True), (5.9, False)])
def test_full_depth_less_its_tolerance_lies_below_the_tops(expected_mm, allowed):
    plan = PLAN.model_copy(update={"expected_depth_mm": expected_mm, "depth_tolerance_mm": 1.0, "clearance_mm": 5.0})
    if allowed:
        plan.check()
    else:
        with pytest.raises(LimitError, match="still above the blocks"):
            plan.check()
