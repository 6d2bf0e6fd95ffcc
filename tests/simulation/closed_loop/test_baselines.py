import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulation.closed_loop.baselines import (
    CONTROLLERS,
    DirectionOnly,
    View,
    blind_grid,
    damped,
    error_from_levers,
    lever_arms_mm,
    random_search,
    spiral_search,
)

REACH = (15.0, 15.0)


def view(attempt=1, classes=None, estimate=None, error=(3.0, -2.0)):
    return View(attempt, error, np.zeros(6), 56.0, 30.0, classes, estimate)


@pytest.mark.parametrize("make", [random_search, blind_grid, spiral_search])
def test_a_search_visits_its_guesses_whatever_is_felt(make):
    search = make(3, REACH)
    at = np.cumsum([search.choose(view(n)) for n in range(1, 15)], axis=0)
    assert np.allclose(at, -search.guesses[:14])
    assert np.all(np.abs(search.guesses) <= REACH)


@pytest.mark.parametrize("make", [blind_grid, spiral_search])
def test_a_systematic_search_never_tries_a_pose_twice(make):
    guesses = make(0, REACH).guesses[:14]
    assert len(np.unique(guesses.round(6), axis=0)) == 14
    assert np.hypot(*guesses[0]) < np.hypot(*guesses[-1])


def test_direction_alone_halves_its_step_where_a_sign_turns():
    chooser = DirectionOnly()
    assert chooser.choose(view(classes={"5": 0.9, "1": 0.1})) == (-8.0, -8.0)
    assert chooser.choose(view(classes={"1": 0.9, "5": 0.1})) == (4.0, 0.0)


@given(st.floats(-15, 15), st.floats(-15, 15), st.integers(2, 15))
def test_a_damped_move_reduces_the_estimated_error_and_is_short_later(x, theta, attempt):
    first, later = damped((x, theta), 1), damped((x, theta), attempt)
    assert first == pytest.approx((-0.7 * x, -0.7 * theta))
    assert np.all(np.abs(later) <= 4.0)


@given(st.floats(-14, 14).filter(lambda x: abs(x) > 3), st.floats(-20, 20), st.floats(5, 40))
def test_the_lever_arm_gives_the_error_across_the_gap(x_mm, along_mm, force_n):
    side = np.sign(x_mm)
    at = np.array([side * 28.0 - x_mm, along_mm, -30.0])
    force = np.array([-0.2 * side * force_n, 0.1, force_n])
    lever = lever_arms_mm(np.concatenate([force, np.cross(at, force)]), 30.0)
    assert lever == pytest.approx((at[0], at[1]), abs=1e-6)
    assert error_from_levers(lever, 56.0)[0] == pytest.approx(x_mm, abs=1e-6)


def test_only_the_oracle_uses_the_truth():
    for name, controller in CONTROLLERS.items():
        if controller.make is None:
            continue
        seen = [
            controller.make(5, REACH).choose(view(1, {"near": 1.0}, (1.0, 1.0), error)) for error in ((9, 9), (1, 0))
        ]
        assert (seen[0] != seen[1]) == (name == "oracle")
