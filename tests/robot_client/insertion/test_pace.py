"""Two speeds in one descent, and no higher between attempts than the move needs: no bound in mm is given up for it."""

import itertools
import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_client.insertion.events import Move, Send, Standstill, Tick
from robot_client.insertion.lease import PAUSE_S
from robot_client.insertion.limits import Limits
from robot_client.insertion.machine import Phase, State, step
from robot_client.insertion.motion import CYCLE_S, MotionGuide, Ramp, Ramps
from robot_client.insertion.pace import Pace, Tops
from robot_client.insertion.profile import plan_legs
from service.contract import wire
from tests.robot_client.insertion.stories import (
    APPROACH,
    PLAN,
    TO_ARMING,
    armed,
    at,
    correction,
    held,
    hello,
    run,
    service,
    slip,
    watching,
)

RAMPS = Ramps(descend=Ramp(speed_mm_s=10.0, acceleration_mm_s2=400.0, jerk_mm_s3=8000.0))
FAST = PLAN.model_copy(
    update={
        "pace": Pace(fast_mm_s=25.0, fast_travel_mm=2.5, lift_mm=4.0),
        "pause_s": PAUSE_S,
        "limits": Limits(max_descent_speed_mm_s=25.0),
        "ramps": RAMPS,
    }
)
TOPS_MM = APPROACH.z_mm - FAST.clearance_mm
LEGS = st.lists(st.tuples(st.floats(0.01, 60.0), st.floats(0.5, 60.0)), min_size=1, max_size=5)


def camera(rate_hz):
    return wire.CameraEntry.model_construct(finger="left", state="streaming", frame_rate_hz=rate_hz)


def begun(plan, rate_hz=60.0):
    """Commands up to the descent, with cameras of that rate."""
    story = [*TO_ARMING[:1], service(hello(cameras=(camera(rate_hz),))), *TO_ARMING[2:], service(armed(1))]
    return run(story, State(plan))


def descent(commands):
    (move,) = [c for c in commands if isinstance(c, Move) and c.motion == "descend"]
    return move


@given(LEGS, st.floats(50, 1500), st.floats(500, 50000))
def test_no_leg_of_a_descent_is_faster_than_allowed_there_and_no_change_harder(legs, acceleration, jerk):
    profile = plan_legs(legs, acceleration, jerk)
    ends = list(itertools.accumulate(way for way, _ in legs))
    dt = profile.duration_s / 600
    way = [profile.position(k * dt) for k in range(601)]
    assert way[0] == 0.0
    assert way[-1] == pytest.approx(ends[-1])
    assert profile.position(profile.duration_s + 1.0) == pytest.approx(ends[-1])
    speeds = [(b - a) / dt for a, b in itertools.pairwise(way)]
    for (a, b), speed in zip(itertools.pairwise(way), speeds, strict=True):
        crossed = [k for k, end in enumerate(ends) if end > a and (k == 0 or ends[k - 1] < b)]
        assert -1e-6 <= speed <= max(legs[k][1] for k in crossed) + 1e-6
    assert max(abs(b - a) / dt for a, b in itertools.pairwise(speeds)) <= acceleration * 1.001 + 1e-6


def test_a_descent_is_fast_only_well_above_and_well_below_the_tops():
    _, commands = begun(FAST)
    move = descent(commands)
    guide = MotionGuide(FAST.limits, FAST.ramps, APPROACH)
    guide.move(move.target, "descend", 1e9, move.legs)
    fastest_mm_s = 0.0
    while guide.moving:
        before = guide.target.z_mm
        after = guide.advance(CYCLE_S, 0.0).z_mm
        speed = (before - after) / CYCLE_S
        fastest_mm_s = max(fastest_mm_s, speed)
        if TOPS_MM - FAST.pace.below_mm <= after and before <= TOPS_MM + FAST.pace.above_mm:
            assert speed <= 10.0 + 1e-6
    assert fastest_mm_s == pytest.approx(25.0)


def test_the_lease_of_a_fast_descent_keeps_both_ways_in_mm():
    state, commands = begun(FAST)
    lasts_s = descent(commands).until_s
    lag_s = FAST.lease.stop_lag_s
    assert 25.0 * (lasts_s + lag_s) <= FAST.pace.fast_travel_mm + 1e-9
    assert 10.0 * (lasts_s + lag_s) <= FAST.lease.travel_mm
    state, (renewed,) = step(state, service(watching(1, 0.03), 0.04))
    assert renewed.until_s == pytest.approx(0.03 + lasts_s, abs=1e-4)
    state, _ = step(state, Tick(at_s=0.03 + lasts_s + PAUSE_S + 0.001))
    assert state.phase is Phase.FAILED


@pytest.mark.parametrize(("rate_hz", "fast_mm_s"), [(37.0, 14.92), (30.0, 13.64), (25.0, 12.5)])
def test_with_cameras_too_slow_for_it_the_fast_legs_are_slower(rate_hz, fast_mm_s):
    """A lease of 2.5 mm is for 25 mm/s; below 15 mm/s it is 1.5."""
    _, commands = begun(FAST, rate_hz)
    move = descent(commands)
    assert [speed for _, speed in move.legs] == pytest.approx([fast_mm_s, 10.0, fast_mm_s], abs=0.01)
    assert fast_mm_s * (move.until_s + FAST.lease.stop_lag_s) <= 1.5 + 1e-2
    assert move.until_s >= 1.5 / rate_hz, "and still lasts a frame and a half"


@given(st.floats(1.0, 25.0), st.floats(1.0, 2.5), st.floats(0.0, 0.3), st.one_of(st.none(), st.floats(5.0, 200.0)))
def test_no_fast_leg_is_allowed_further_than_its_lease_or_faster_than_it_was_set(fast_mm_s, travel_mm, late_s, rate_hz):
    pace = Pace(fast_mm_s=fast_mm_s, fast_travel_mm=travel_mm)
    plan = FAST.at_speed(4.0).model_copy(update={"pace": pace, "lease": FAST.lease.late_by(late_s)})
    legs = plan.with_legs_for([camera(rate_hz)])
    assert legs.with_legs_for([camera(rate_hz)]) == legs
    if legs.pace.fast_mm_s is None:
        return
    assert plan.ramps.descend.speed_mm_s < legs.pace.fast_mm_s <= fast_mm_s
    assert legs.fast_lease.travel_mm <= travel_mm
    legs.fast_lease.check(legs.pace.fast_mm_s)
    legs.fast_lease.check_rate(legs.pace.fast_mm_s * (1.0 - 1e-9), camera(rate_hz))


def test_what_ships_is_slow_only_around_the_tops_and_keeps_its_lease_on_every_leg():
    plan = PLAN.model_copy(update={"pace": Pace(), "ramps": Ramps(), "pause_s": PAUSE_S})
    plan.check()
    _, commands = begun(plan, 30.0)
    move = descent(commands)
    probing_mm_s = plan.ramps.descend.speed_mm_s
    assert [speed for _, speed in move.legs] == [10.0, probing_mm_s, 10.0]
    assert [height for height, _ in move.legs[:2]] == [TOPS_MM + 2.0, TOPS_MM - 4.0]
    for _, speed in move.legs:
        assert speed * (move.until_s + plan.lease.stop_lag_s) <= 1.5 + 1e-9


@given(st.floats(0.1, 90.0), st.floats(0.0, 300.0), st.floats(5.0, 200.0))
def test_a_move_turns_no_faster_than_55_deg_a_second(turn_deg, way_mm, speed_mm_s):
    ramps = Ramps(travel=Ramp(speed_mm_s=speed_mm_s, acceleration_mm_s2=300.0, jerk_mm_s3=5000.0))
    end = APPROACH.model_copy(update={"x_mm": APPROACH.x_mm + way_mm, "yaw_deg": APPROACH.yaw_deg + turn_deg})
    profile = ramps.profile(APPROACH, end, "travel")
    middle_s, dt = profile.duration_s / 2, 1e-4
    went = profile.position(middle_s + dt) - profile.position(middle_s - dt)
    assert went / (2 * dt) / profile.length * turn_deg <= 55.0 + 1e-3


@pytest.mark.parametrize("pace", [Pace(fast_mm_s=26.0), Pace(fast_mm_s=25.0, fast_travel_mm=2.6)])
def test_a_pace_beyond_limits_or_lease_moves_nothing(pace):
    assert held(*step(State(FAST.model_copy(update={"pace": pace})), TO_ARMING[0]))


def test_the_service_is_told_each_speed_when_its_leg_begins():
    state, commands = begun(FAST)
    legs = [c.message for c in commands if isinstance(c, Send) and c.message.type == "descending"]
    for cycle in range(1, 400):
        now_s = cycle * 0.01
        state, _ = step(state, service(watching(1, now_s - 0.005), now_s))
        state, sent = step(state, Tick(at_s=now_s))
        legs += [c.message for c in sent if isinstance(c, Send)]
    assert legs[0].speed_mm_s > 10.0
    assert [leg.speed_mm_s for leg in legs[1:]] == [10.0, 25.0]
    band_mm = [APPROACH.z_mm - height_mm for height_mm in (TOPS_MM + FAST.pace.above_mm, TOPS_MM - FAST.pace.below_mm)]
    assert [leg.start_mm for leg in legs] == pytest.approx([0.0, *band_mm], abs=1.0)  # within the change of speed


def test_after_a_pause_in_the_descent_the_next_speed_is_told_as_much_later():
    state, _ = begun(FAST.model_copy(update={"pause_s": PAUSE_S}))
    due_s = state.speeds[0][0]
    state, _ = step(state, service(watching(1, 0.19), 0.2))
    assert state.speeds[0][0] == pytest.approx(due_s + 0.2 - FAST.lasts_s, abs=1e-3)


def test_a_leg_that_is_due_while_the_arm_stands_is_told_when_the_arm_has_gone_on_and_reached_it():
    state, _ = begun(FAST)
    due_s, lasts_s = state.speeds[0][0], FAST.lasts_s
    ends_s = due_s - 0.02
    for seen_s in (0.5 * (ends_s - lasts_s), ends_s - lasts_s):
        state, _ = step(state, service(watching(1, seen_s), seen_s))
    assert state.until_s == pytest.approx(ends_s, abs=1e-3)
    assert step(state, Tick(at_s=due_s + 0.01)) == (state, ()), "it stands short of the next leg"
    state, (_, paused) = step(state, service(watching(1, due_s), due_s + 0.03))
    assert paused.message.paused_s == pytest.approx(0.05, abs=1e-3)
    _, (leg,) = step(state, Tick(at_s=due_s + 0.051))
    assert (leg.message.speed_mm_s, leg.message.paused_s) == (10.0, 0.0)


def blocked(plan, z_mm):
    """After the first attempt was stopped at a height, and corrected by -3 mm and -2 deg."""
    state, _ = begun(plan)
    return run([service(slip(1)), at(APPROACH.at_height(z_mm), Standstill), service(correction(1))], state)


def test_an_attempt_is_taken_up_only_as_high_as_the_move_needs_and_the_next_one_starts_there():
    state, commands = blocked(FAST, TOPS_MM - 1.5)
    up = commands[-1].target
    assert up == APPROACH.at_height(TOPS_MM + 4.0)
    state, (over,) = run([at(up)], state)
    assert over.target == up.corrected(-3.0, -2.0)
    state, commands = run([at(over.target), service(armed(2))], state)
    assert descent(commands).target.z_mm == APPROACH.z_mm - FAST.expected_depth_mm
    (begins,) = [c.message for c in commands if isinstance(c, Send) and c.message.type == "descending"]
    assert begins.start_mm == pytest.approx(1.0)


@pytest.mark.parametrize("z_mm", [TOPS_MM - 4.1, TOPS_MM - 15.0])
def test_an_object_that_stood_between_the_blocks_is_taken_up_to_the_approach(z_mm):
    _, commands = blocked(FAST, z_mm)
    assert commands[-1].target == APPROACH


@given(st.floats(-18.9, 5.0))
def test_after_any_stop_the_arm_goes_up_at_least_by_the_lift_and_never_above_the_approach(off_mm):
    _, commands = blocked(FAST, TOPS_MM + off_mm)
    up_mm = commands[-1].target.z_mm
    assert min(APPROACH.z_mm, TOPS_MM + off_mm + 4.0) <= up_mm <= APPROACH.z_mm


@pytest.mark.parametrize("off_mm", [-0.03, 0.0, 0.03])
def test_no_leg_is_so_short_that_it_might_lead_up_from_where_the_arm_settled(off_mm):
    """The arm was raised to the height at which the slow leg begins; it stands a hair above or below."""
    pace = Pace(fast_mm_s=10.0, lift_mm=2.0)
    start = APPROACH.at_height(TOPS_MM + pace.above_mm)
    legs = pace.legs(start.z_mm + off_mm, APPROACH.z_mm - 25.0, 4.0, Tops(TOPS_MM, TOPS_MM))
    assert [speed for _, speed in legs] == [4.0, 10.0]
    MotionGuide(FAST.limits, FAST.ramps, start).move(start.at_height(APPROACH.z_mm - 25.0), "descend", 1.0, legs)


@pytest.mark.parametrize("last_mm", [0.05, 0.1, 0.15])
def test_a_descent_that_ends_just_below_the_slow_leg_ends_there(last_mm):
    """At 9.1 mm, of 5 mm of air and 4 mm of probing, the last leg ended 0.1 mm too high, and every descent failed."""
    pace, bottom_mm = Pace(fast_mm_s=10.0), APPROACH.z_mm - (9.0 + last_mm)
    legs = pace.legs(APPROACH.z_mm, bottom_mm, 4.0, Tops(TOPS_MM, TOPS_MM))
    assert legs[-1][0] == bottom_mm
    MotionGuide(FAST.limits, FAST.ramps, APPROACH).move(APPROACH.at_height(bottom_mm), "descend", 1.0, legs)


def test_after_a_regrasp_the_arm_is_slow_where_the_tops_were_met():
    met = Tops(TOPS_MM, TOPS_MM + 3.0)
    state = State(FAST.model_copy(update={"fixture": True}), attempt=2, armed=APPROACH, met=met)
    again = replace(state, reason="service: refused: turned_in_hand: x").afresh("second")
    assert State(again).tops == met


@pytest.mark.parametrize("legs", [[], [(math.nan, 5.0)], [(10.0, 5.0), (3.0, 0.0)], [(math.inf, 5.0)], [(-1.0, 5.0)]])
def test_legs_without_a_way_or_a_speed_are_refused(legs):
    with pytest.raises(ValueError, match="expected finite ways and limits above 0"):
        plan_legs(legs, 100.0, 2000.0)
