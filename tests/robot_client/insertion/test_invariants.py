"""Invariants of the insertion's state machine under any input."""

import math

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from robot_client.insertion.events import (
    MOTION_COMMANDS,
    Arrived,
    Begin,
    Failure,
    Grasp,
    Grasped,
    Hold,
    Move,
    PartLost,
    Send,
    Standstill,
    Stood,
    Tick,
)
from robot_client.insertion.limits import check_pose
from robot_client.insertion.machine import Phase, State, step
from service.contract import wire
from tests.robot_client.insertion.stories import (
    APPROACH,
    ID,
    PLAN,
    armed,
    at,
    correction,
    hello,
    no_decision,
    service,
    slip,
    watching,
)

FOLLOWS = {
    Phase.START: {Phase.GREETING},
    Phase.GREETING: {Phase.LEARNING, Phase.GRASPING},
    Phase.LEARNING: {Phase.GRASPING},
    Phase.GRASPING: {Phase.APPROACHING},
    Phase.APPROACHING: {Phase.ARMING},
    Phase.ARMING: {Phase.DESCENDING},
    Phase.DESCENDING: {Phase.STOPPING},
    Phase.STOPPING: {Phase.DECIDING, Phase.CLOSING},
    Phase.DECIDING: {Phase.RETRACTING},
    Phase.RETRACTING: {Phase.CORRECTING},
    Phase.CORRECTING: {Phase.ARMING},
    Phase.CLOSING: {Phase.INSERTED},
    Phase.INSERTED: set(),
    Phase.FAILED: set(),
}
EXPECTED = {  # what moves the story on, so that long stories are told at all
    Phase.START: 0,
    Phase.GREETING: 1,
    Phase.LEARNING: 16,
    Phase.GRASPING: 2,
    Phase.APPROACHING: 3,
    Phase.ARMING: 4,
    Phase.DESCENDING: 5,
    Phase.STOPPING: 6,
    Phase.DECIDING: 7,
    Phase.RETRACTING: 3,
    Phase.CORRECTING: 3,
    Phase.CLOSING: 8,
}
VALUES = (0.0, -0.7, 2.0, -4.0, 9.0, 15.9, -16.1, 40.0, math.nan, math.inf)


def make_event(kind, number, state, now):
    """Event ``kind`` with details out of ``number`` (0..255)."""
    attempt = max(1, min(15, state.attempt + (0 if number % 8 else number // 8 % 3 - 1)))
    insertion_id = ID if number % 61 else "other"
    here = state.armed or APPROACH
    dx, dtheta = VALUES[number % 7 if number < 250 else 8], VALUES[number // 7 % 7 if number < 253 else 9]
    depth = (24.5, 7.0, 6.2, 1.0, 26.0, 23.9)[number % 6]
    makers = (
        lambda: Begin(at_s=now, pose=APPROACH.at_height(20.0 + number / 4)),
        lambda: service(hello(insertion_id), now),
        lambda: Grasped(at_s=now, width_mm=50.0),
        lambda: at(here if state.path or number % 4 else here.at_height(30.0), Arrived, now),
        lambda: service(armed(attempt, insertion_id, now), now),
        lambda: service(slip(attempt, insertion_id), now),
        lambda: at(here.at_height(here.z_mm - depth), Standstill, now),
        lambda: service(correction(attempt, dx, dtheta, insertion_id), now),
        lambda: service(wire.Finished(insertion_id=insertion_id, outcome="inserted", attempts=1), now),
        lambda: service(no_decision(attempt, "stale" if number % 9 else "non_finite", insertion_id), now),
        lambda: PartLost(at_s=now),
        lambda: Tick(at_s=now + (0.0 if number % 5 else 100.0)),
        lambda: service(wire.Fault(insertion_id=insertion_id, code="internal", detail="d"), now),
        lambda: service(watching(attempt, now - number / 1000, insertion_id), now),
        lambda: Failure(
            at_s=now, source=("arm", "gripper", "service", "operator")[number % 4], code="internal", detail="d"
        ),
        lambda: Standstill(at_s=now, pose=here),
        lambda: service(wire.OpenLearnt(insertion_id=insertion_id), now),
        lambda: Stood(at_s=now, stood_s=number / 100),
    )
    return makers[kind]()


def message_of(event):
    return getattr(event, "message", None)


class Watch:
    """The invariants, checked after every step."""

    def __init__(self):
        self.arms = []
        self.aborts = 0
        self.captured_s = 0.0  # capture of the newest frame that was judged
        self.corrected = 0.0, 0.0

    def check(self, before, event, state, commands):
        moves = [c for c in commands if isinstance(c, MOTION_COMMANDS)]
        if before.done:
            assert (state, commands) == (before, ())
        if state.phase is not before.phase:
            assert state.phase is Phase.FAILED or state.phase in FOLLOWS[before.phase]
        if state.phase is Phase.FAILED:
            assert not moves, "no motion once failed"
            assert state.reason
            if not before.done:
                assert any(isinstance(c, Hold) for c in commands)
                self.aborts += sum(isinstance(c, Send) and c.message.type == "abort" for c in commands)
                assert self.aborts == 1
        self.check_reactions(before, event, state, commands)
        if not state.done and state.phase is not Phase.START:
            assert math.isfinite(state.deadline_s), "nothing may wait for ever"
        self.captured_s = max(self.captured_s, getattr(message_of(event), "frame_captured_ns", 0) / 1e9)
        for command in commands:
            self.check_command(before, state, command)
            until_s = getattr(command, "until_s", None)
            if until_s is not None:
                assert event.at_s < until_s <= self.captured_s + PLAN.lease.lasts_s(10.0) + 1e-9

    def check_reactions(self, before, event, state, commands):
        if isinstance(event, Tick) and event.at_s >= before.deadline_s and not before.done:
            assert state.done
        if isinstance(event, Failure) and not before.done:
            assert (state.phase, type(commands[0])) == (Phase.FAILED, Hold)
        message = getattr(event, "message", None)
        if before.phase is Phase.DESCENDING and (isinstance(event, PartLost) or getattr(message, "type", "") == "slip"):
            assert isinstance(commands[0], Hold), "slip holds, before anything else"
        if state.phase is Phase.CLOSING and before.phase is not Phase.CLOSING:
            assert before.armed.z_mm - event.pose.z_mm >= 24.0, "only full depth may be an insertion"
        if state.phase is Phase.INSERTED and before.phase is not Phase.INSERTED:
            assert (before.phase, message.type, message.outcome) == (Phase.CLOSING, "finished", "inserted")

    def check_command(self, before, state, command):
        if isinstance(command, Grasp):
            assert before.phase in {Phase.GREETING, Phase.LEARNING}
        if isinstance(command, Send) and command.message.type == "arm":
            self.arms.append(command.message.attempt)
            assert self.arms == list(range(1, len(self.arms) + 1))
            assert len(self.arms) <= 15
        if not isinstance(command, Move):
            return
        check_pose(PLAN.limits, command.target)
        assert all(map(math.isfinite, command.target.model_dump().values()))
        if command.motion == "descend":
            assert before.phase is Phase.ARMING
            assert command.target == state.armed.at_height(state.armed.z_mm - 25.0)
        elif command.motion == "retract" and before.phase is Phase.GRASPING:
            assert before.pose.z_mm < command.target.z_mm
            assert command.target == before.pose.at_height(command.target.z_mm), "straight up, from wherever it began"
        elif command.motion == "retract":
            assert before.phase is Phase.DECIDING
            assert command.target == before.armed, "only along the recorded vertical"
            change = state.path[0]
            assert abs(change.x_mm - before.armed.x_mm) <= 16.0
            assert abs(change.yaw_deg - before.armed.yaw_deg) <= 16.0
            assert (change.y_mm, change.z_mm) == (before.armed.y_mm, before.armed.z_mm)
        else:
            assert command.target.z_mm >= APPROACH.z_mm, "never sideways below the approach height"


MILD = [  # details that make a blocked attempt with a small correction: stories of many attempts need them
    n
    for n in range(1, 250)
    if n % 61 and n % 8 and n % 4 and n % 6 in (1, 2, 3, 5) and n % 7 in (0, 1) and n // 7 % 7 in (0, 1)
]


def tell(story):
    """Play a story of bytes; each two make an event, which follows the plot or is anything.

    The first byte says how much of it is anything (0, 3, 25 or 60 %), and whether the plot is a mild one.
    """
    state, now, watch = State(PLAN), 0.0, Watch()
    wild, mild = (0, 8, 64, 154)[story[0] % 4], story[0] % 8 < 4
    for index in range(0, len(story) - 1, 2):
        choice, number = story[index], story[index + 1]
        now += 0.01
        kind = choice % 18
        if choice >= wild:
            kind = EXPECTED.get(state.phase, kind)
            number = MILD[number % len(MILD)] if mild else number
        event = make_event(kind, number, state, now)
        before = state
        state, commands = step(before, event)
        watch.check(before, event, state, commands)
        if state.done and index > 20 and choice % 4 == 0:
            state, watch = State(PLAN), Watch()
    return len(story) // 2


SLACK = [HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.large_base_example]


@settings(max_examples=150, deadline=None, suppress_health_check=SLACK)
@given(st.binary(min_size=100, max_size=400))
def test_no_story_breaks_an_invariant(story):
    tell(story)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_no_story_of_a_million_steps_breaks_an_invariant():
    steps = 0

    @settings(max_examples=700, deadline=None, suppress_health_check=SLACK, database=None)
    @given(st.binary(min_size=3500, max_size=4000))
    def play(story):
        nonlocal steps
        steps += tell(story)

    while steps < 1_000_000:
        play()
    print(f"{steps} steps")
