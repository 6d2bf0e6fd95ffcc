"""A load that reverses while the object is held shows that something else bears it; its end is then a release."""

import numpy as np
import pytest

from service.perception.slip.phases import Grasp, GraspPhases

DOWN, UP, NONE = np.array([0.005, 0.04]), np.array([0.01, -0.03]), np.zeros(2)
TOUCHED, EMPTY = (3.0, 2.0), (0.3, 0.2)


def phases_of(loads, slips=(), emptied=4):
    """Phases of two touched gels under these loads [frames], which are empty afterwards."""
    phases = GraspPhases()
    history = [phases.update(TOUCHED, slips=k in slips, loads=[load, load]) for k, load in enumerate(loads)]
    return history + [phases.update(EMPTY, slips=False, loads=[NONE, NONE]) for _ in range(emptied)]


def test_an_object_that_is_put_down_and_let_go_is_released():
    history = phases_of([DOWN] * 12 + [UP] * 4)
    assert history[15] == "hold"
    assert history.index("released") - 16 <= 2
    assert "lost" not in history


def test_an_object_that_rests_without_any_load_is_still_borne():
    assert phases_of([DOWN] * 12 + [UP] * 4 + [NONE] * 40)[-1] == "released"


@pytest.mark.parametrize(
    "last",
    [
        [],
        [DOWN * share for share in (0.7, 0.4, 0.1)],
        [UP, DOWN, UP, DOWN, DOWN],
        [UP * 0.3] * 4,
    ],
    ids=["at once", "fades", "is shaken", "moves by no more than an open gel"],
)
def test_an_object_whose_load_keeps_its_direction_is_lost(last):
    assert phases_of([DOWN] * 12 + last)[-1] == "lost"


def test_a_load_on_one_finger_is_enough_and_a_hidden_gel_has_no_say():
    phases = GraspPhases()
    for load in [DOWN] * 12 + [UP] * 3:
        phases.update(TOUCHED, slips=False, loads=[load, None])
    assert phases.borne
    assert [phases.update(EMPTY, slips=False, loads=[None, None]) for _ in range(2)][-1] == "released"


def test_a_light_load_has_no_direction():
    assert phases_of([DOWN * 0.3] * 12 + [UP] * 4)[-1] == "lost"


def test_motion_while_something_else_bears_the_object_is_no_slip():
    assert "slip" not in phases_of([DOWN] * 12 + [UP] * 4, slips=range(12, 16))
    assert "slip" in phases_of([DOWN] * 16, slips=range(12, 16))


def test_an_object_that_swings_while_it_slides_is_lost():
    assert phases_of([DOWN] * 12 + [DOWN, UP, UP], slips=range(12, 15))[-1] == "lost"


def test_a_load_that_stays_reversed_becomes_the_load():
    assert phases_of([DOWN] * 12 + [UP] * 40)[-1] == "lost"


def test_the_next_grasp_begins_anew():
    phases = GraspPhases()
    for load in [DOWN] * 12 + [UP] * 4:
        phases.update(TOUCHED, slips=False, loads=[load, load])
    history = [phases.update(EMPTY, slips=False, loads=[NONE, NONE]) for _ in range(3)]
    history += [phases.update(TOUCHED, slips=False, loads=[UP, UP]) for _ in range(8)]
    history += [phases.update(EMPTY, slips=False, loads=[NONE, NONE]) for _ in range(3)]
    assert [history[2], history[10], history[-1]] == ["released", "hold", "lost"]


def test_without_loads_as_in_a_live_session_an_emptied_hand_is_lost():
    grasp = Grasp(2, "hold")
    assert [grasp.update(touches, [False, False]) for touches in [TOUCHED] * 6 + [EMPTY] * 2][-1] == "lost"
