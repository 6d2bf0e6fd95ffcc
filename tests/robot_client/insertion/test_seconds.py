"""Where the seconds of an insertion went: no event's time is lost, and each phase has its own."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_client.insertion.events import Standstill
from robot_client.insertion.machine import State, step
from robot_client.insertion.seconds import Seconds
from tests.robot_client.insertion.stories import (
    ABOVE,
    APPROACH,
    PLAN,
    TO_ARMING,
    armed,
    at,
    correction,
    service,
    slip,
    watching,
)

PHASES = ["approach"] * 3 + ["arm", "guarded descent", "stop", "wait for frames", "retract"]
GAPS_S = st.lists(st.floats(0.0, 0.02), min_size=len(PHASES), max_size=len(PHASES))


@given(GAPS_S, st.floats(0.0, 1e4), st.floats(0.0, 30.0))
def test_every_second_is_spent_once_by_the_phase_in_which_it_passed(gaps_s, began_s, latency_ms):
    state, seconds = State(PLAN), Seconds()

    def happens(event):
        nonlocal state
        state, _ = step(state, event)
        seconds.on_event(state, event)

    times_s = list(itertools.accumulate(gaps_s, initial=began_s))
    for event in TO_ARMING[:3]:
        happens(event.model_copy(update={"at_s": began_s}))
    for event, at_s in zip(TO_ARMING[3:], times_s[1:4], strict=True):
        happens(event.model_copy(update={"at_s": at_s}))
    armed_s, slip_s, still_s, decided_s, up_s = times_s[4:]
    happens(service(armed(1, at_s=armed_s), armed_s))
    happens(service(watching(1, slip_s), slip_s))
    happens(service(slip(1), slip_s))
    happens(at(APPROACH.at_height(28.0), Standstill, still_s))
    decision = correction(1).model_copy(update={"latency_ms": {"since_last_frame": latency_ms}})
    happens(service(decision, decided_s))
    happens(at(ABOVE, at_s=up_s))
    expected = dict.fromkeys(seconds.spent, 0.0)
    for name, gap_s in zip(PHASES, gaps_s, strict=True):
        expected[name] += gap_s
    expected["decide"] = min(latency_ms / 1e3, expected["wait for frames"])
    expected["wait for frames"] -= expected["decide"]
    assert seconds.spent == pytest.approx(expected, abs=1e-7)
