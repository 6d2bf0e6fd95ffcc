"""An object that the blocks push up in the hand is brought deeper, as far as is allowed."""

import pytest

from robot_client.insertion.events import Standstill
from robot_client.insertion.machine import Phase, State, step
from robot_client.session.report import Report
from service.contract import wire
from tests.robot_client.insertion.stories import (
    APPROACH,
    ID,
    PLAN,
    TO_ARMING,
    armed,
    at,
    correction,
    held,
    run,
    service,
    slip,
)


def _second_descent(allowance_mm, first_mm, second_mm, *, pressed_mm=0.4):
    """State and descent target of the third attempt, two blocked ones before it, and the depths those stopped at.

    ``pressed_mm``: of the first one; None: it stopped in the air.
    """
    state = State(PLAN.model_copy(update={"creep_allowance_mm": allowance_mm}))
    state, _ = run(TO_ARMING, state)
    for attempt, depth_mm in ((1, first_mm), (2, second_mm)):
        blocked = at(APPROACH.at_height(APPROACH.z_mm - depth_mm), Standstill)
        stopped = slip(attempt, pressed_mm=pressed_mm if attempt == 1 else 0.4)
        state, _ = run([service(armed(attempt)), service(stopped), blocked], state)
        state, _ = run([service(correction(attempt, 0.0, 0.0)), at(APPROACH), at(APPROACH)], state)
    return run([service(armed(3))], state)


@pytest.mark.parametrize(
    ("allowance_mm", "second_mm", "bottom_mm"), [(0.0, 9.0, 25.0), (4.0, 9.0, 27.5), (2.0, 9.0, 27.0), (4.0, 6.0, 25.0)]
)
def test_a_part_pushed_up_in_the_hand_is_brought_as_much_deeper_as_is_allowed(allowance_mm, second_mm, bottom_mm):
    _, commands = _second_descent(allowance_mm, 6.5, second_mm)
    assert commands[-1].target == APPROACH.at_height(APPROACH.z_mm - bottom_mm)


def test_where_an_attempt_stopped_in_the_air_no_object_was_pushed_up():
    state, _ = _second_descent(4.0, 0.4, 6.5, pressed_mm=None)
    assert state.creep_mm == 0.0


@pytest.mark.parametrize(("allowance_mm", "says"), [(0.0, "may be 2.5 mm HIGHER"), (4.0, "went 2.5 mm deeper")])
def test_the_last_screen_says_where_the_part_sits_in_the_hand(allowance_mm, says):
    state, commands = _second_descent(allowance_mm, 6.5, 9.0)
    bottom = commands[-1].target
    finished = service(wire.Finished(insertion_id=ID, outcome="inserted", attempts=3))
    state, _ = run([at(bottom), at(bottom, Standstill), finished], state)
    assert state.phase is Phase.INSERTED
    assert says in "\n".join(Report(lambda: None, print).final(state, "", {}, {}))


def test_an_allowance_that_leaves_the_box_never_starts():
    assert "z_mm" in held(*step(State(PLAN.model_copy(update={"creep_allowance_mm": 6.0})), TO_ARMING[0]))
