"""A probe in the state machine: it follows no correction, and goes from start to start in the air."""

import pytest

from robot_client.insertion.events import Move, Send, Standstill
from robot_client.insertion.state import Phase, State
from service.contract import wire
from tests.robot_client.insertion.stories import (
    APPROACH,
    ID,
    PLAN,
    TO_ARMING,
    TO_DECISION,
    armed,
    at,
    correction,
    held,
    no_decision,
    run,
    service,
    slip,
)

PROBE = State(PLAN.model_copy(update={"purpose": "probe"}))


@pytest.mark.parametrize("purpose", ["probe", "timing"])
@pytest.mark.parametrize("answer", [correction(1), no_decision(1), no_decision(1, "contradictory")])
def test_a_probe_goes_straight_up_after_whatever_was_decided_and_ends_there(answer, purpose):
    begun = State(PLAN.model_copy(update={"purpose": purpose}))
    _, before = run(TO_DECISION, begun)
    state, commands = run([*TO_DECISION, service(answer), at(APPROACH)], begun)
    moves = [c.target for c in commands[len(before) :] if isinstance(c, Move)]
    assert (state.phase, moves) == (Phase.PROBED, [APPROACH])
    assert isinstance(commands[-1], Send)
    assert commands[-1].message.cause == "probed"


OTHERS = tuple(APPROACH.corrected(x_mm, yaw_deg) for x_mm, yaw_deg in ((-10.0, 3.0), (-4.0, -9.0)))
SEVERAL = State(PROBE.plan.model_copy(update={"starts": OTHERS}))


def attempt_at(start, number, answer):
    """From arming to the way up, with the probe's next start as the end of it."""
    low = start.at_height(28.0)
    return [service(armed(number)), service(slip(number)), at(low, Standstill), service(answer), at(start)]


def test_a_probe_goes_from_start_to_start_in_the_air_whatever_was_decided():
    answers = [correction(1), no_decision(2, "contradictory"), correction(3)]
    events, starts = [*TO_ARMING], (APPROACH, *OTHERS)
    for number, (start, answer) in enumerate(zip(starts, answers, strict=True), 1):
        events += attempt_at(start, number, answer)
        events += [at(after) for after in starts[number : number + 1]]
    state, commands = run(events, SEVERAL)
    assert state.phase is Phase.PROBED
    arms = [c.message.attempt for c in commands if isinstance(c, Send) and isinstance(c.message, wire.Arm)]
    assert arms == [1, 2, 3]
    ways = [(c.motion, c.target) for c in commands if isinstance(c, Move)][2:]
    downs = [start.at_height(10.0) for start in starts]
    whole = zip(starts, downs, [*OTHERS, None], strict=True)
    each = [[("descend", down), ("retract", start), ("travel", after)] for start, down, after in whole]
    assert ways == [("travel", APPROACH), *(way for some in each for way in some if way[1] is not None)]


def test_a_tilted_tool_keeps_its_tilt_on_the_way_to_the_next_start():
    straighten = wire.Straighten(insertion_id=ID, attempt=2, tilt_deg=0.6, detail="d")
    known = State(SEVERAL.plan.model_copy(update={"signs_known": True}))
    first = [*TO_ARMING, *attempt_at(APPROACH, 1, correction(1)), at(OTHERS[0])]
    tilted = OTHERS[0].tilted(0.6)
    state, commands = run(
        [*first, service(straighten), at(tilted), *attempt_at(tilted, 2, correction(2)), at(OTHERS[1].tilted(0.6))],
        known,
    )
    assert (state.phase, state.attempt) == (Phase.ARMING, 3)
    assert state.armed == OTHERS[1].tilted(0.6)
    assert commands[-1].message.tilt_deg == 0.6


def test_a_probe_that_goes_in_is_the_last_with_its_grasp():
    """The service was told of no end, so it could not watch another attempt."""
    bottom = APPROACH.at_height(10.0)
    into = [*TO_ARMING, service(armed(1)), at(bottom), at(bottom, Standstill), at(APPROACH)]
    state, commands = run(into, SEVERAL)
    assert state.phase is Phase.PROBED
    assert not [c for c in commands if isinstance(c, Send) and isinstance(c.message, wire.Stopped)]


def test_every_start_of_a_probe_is_checked_before_anything_moves():
    far = SEVERAL.plan.model_copy(update={"starts": (*OTHERS, APPROACH.corrected(400.0, 0.0))})
    state, _ = run(TO_ARMING[:1], State(far))
    assert "limits: plan" in held(state, _)


def test_a_probe_is_decided_where_a_single_attempt_is_allowed():
    plan = PROBE.plan.model_copy(update={"limits": PLAN.limits.model_copy(update={"max_attempts": 1})})
    state, _ = run([*TO_DECISION, service(correction(1)), at(APPROACH)], State(plan))
    assert state.phase is Phase.PROBED
