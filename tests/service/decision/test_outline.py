import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.decision.belief import BeliefGrid
from service.decision.outline import YAW_SHARES, Outlines
from tests.service.decision.toy_loop import SHARP, trials

CELLS = np.arange(-22.0, 22.25, 0.5)
ROUND, RECTANGLE = YAW_SHARES.index(0.0), YAW_SHARES.index(1.0)


@given(x=st.floats(-20, 20), theta=st.floats(-20, 20), length=st.floats(20, 150), share=st.sampled_from(YAW_SHARES))
def test_half_of_those_enter_whose_outline_takes_all_of_the_clearance(x, theta, length, share):
    chance = Outlines(CELLS, (2.0, 3.5), length).chances(np.array([x]), np.array([theta]))[
        YAW_SHARES.index(share), 0, 0
    ]
    left_mm = 2.0 - abs(x) - share * 0.5 * length * math.sin(math.radians(abs(theta)))
    assert chance == pytest.approx(1 / (1 + math.exp(-left_mm / 0.35)), abs=1e-12)


def test_without_a_length_a_rectangle_enters_up_to_the_cards_tolerance():
    at_edge = Outlines(CELLS, (2.0, 3.5), None).chances(np.zeros(1), np.array([3.5]))
    assert at_edge[RECTANGLE, 0, 0] == pytest.approx(0.5)


@given(seed=st.integers(0, 10**6), row=st.integers(0, 88), column=st.integers(0, 88))
def test_hits_are_the_sum_over_all_errors_of_what_enters_when_a_cell_is_aimed_at(seed, row, column):
    outlines = Outlines(CELLS, (2.0, 3.5), 90.0)
    errors = np.random.default_rng(seed).dirichlet(np.full(3 * 89 * 89, 0.01)).reshape(3, 89, 89)
    aimed = outlines.chances(CELLS - CELLS[row], CELLS - CELLS[column])
    assert outlines.hits(errors)[row, column] == pytest.approx((errors * aimed).sum(), abs=1e-12)


@pytest.mark.parametrize("clearance_mm", [9.0, 16.0, 21.0])
def test_a_wide_gap_is_not_entered_from_beyond_the_other_end_of_the_grid(clearance_mm):
    """The hits of the cells at both ends, as above, where the convolution could wrap around."""
    outlines = Outlines(CELLS, (clearance_mm, 20.0), 90.0)
    errors = np.random.default_rng(0).dirichlet(np.full(3 * 89 * 89, 0.01)).reshape(3, 89, 89)
    hits = outlines.hits(errors)
    for row, column in ((0, 0), (0, 88), (88, 0), (88, 88), (44, 44)):
        aimed = outlines.chances(CELLS - CELLS[row], CELLS - CELLS[column])
        assert hits[row, column] == pytest.approx((errors * aimed).sum(), abs=1e-12)


def test_a_long_object_that_is_blocked_three_degrees_askew_may_still_be_there():
    """A rectangle of 100 mm takes up 2.6 mm at 3 deg: a block means nothing. A round one would have entered."""
    grid = BeliefGrid(length_mm=100.0)
    grid.layers[:] = 0.0
    at = int(np.flatnonzero(CELLS == 0.0)[0]), int(np.flatnonzero(CELLS == 3.0)[0])
    grid.layers[0, :, *at] = grid.layers[0, :, 80, 44] = 1 / 6  # there, or far away
    grid.absorb_failure()
    there, away = grid.layers[0, :, *at], grid.layers[0, :, 80, 44]
    assert there[RECTANGLE] > 0.8 * away[RECTANGLE]
    assert there[ROUND] < 0.1 * away[ROUND]


def test_a_long_object_needs_fewer_trials_where_the_gripper_tells_its_length():
    """In the toy loop with sharp networks: 51 mm wide and 107 mm long it enters up to 2 deg."""
    rng = np.random.default_rng(0)
    starts = rng.uniform(-15, 15, (40, 2))
    mean = {
        stated_mm: np.mean(
            [
                trials("belief", *start, np.random.default_rng(seed), SHARP, length_mm=107.0, stated_mm=stated_mm)
                for seed, start in enumerate(starts)
            ]
        )
        for stated_mm in (None, 107.0)
    }
    assert mean[107.0] < mean[None]
