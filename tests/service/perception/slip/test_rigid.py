"""The rigid motion of a few points: exact where it is determined, none where it is not."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.perception.slip.rigid import _window_motions, carried_px, fit_motion, moving_patch, refine
from tests.service.perception.synthetic import twist

PITCH_PX = 15.0
SQUARE = np.array([[0.0, 0.0], [15.0, 0.0], [15.0, 15.0], [0.0, 15.0]])


def fitted(points, moved, weights=None, *, scale=False):
    return fit_motion(points, moved, np.ones(len(points)) if weights is None else weights, PITCH_PX, scale=scale)


@given(st.floats(-40.0, 40.0), st.floats(-30.0, 30.0), st.floats(-30.0, 30.0), st.integers(4, 12))
def test_points_that_moved_as_one_body_give_its_motion_four_are_enough(degrees, right_px, down_px, points_n):
    points = np.random.default_rng(points_n).uniform(0.0, 60.0, (points_n, 2))
    points[:4] = SQUARE
    moved = twist(points, degrees, np.array([20.0, 20.0])) + np.array([right_px, down_px])
    motion = fitted(points, moved)
    assert motion is not None
    assert np.degrees(motion.angle_rad) == pytest.approx(degrees, abs=1e-6)
    assert motion.apply(points) == pytest.approx(moved, abs=1e-6)


def test_three_points_or_points_on_a_line_give_none():
    assert fitted(SQUARE[:3], SQUARE[:3]) is None
    line = np.stack([np.arange(8) * PITCH_PX, np.zeros(8)], -1)
    assert fitted(line, line) is None
    assert fitted(SQUARE, SQUARE, np.array([1.0, 1.0, 1.0, 0.0])) is None


@given(st.floats(0.8, 1.25))
def test_a_body_that_grows_is_followed_only_where_scale_is_asked_for(size):
    grown = SQUARE * size
    assert fitted(SQUARE, grown, scale=True).scale == pytest.approx(size)
    assert fitted(SQUARE, grown, scale=False).scale == 1.0


@given(st.integers(0, 50))
def test_points_that_lag_lose_their_weight_and_those_that_lead_keep_it_longer(seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform(0.0, 200.0, (60, 2))
    moved = points + np.array([6.0, 0.0])
    moved[:20] = points[:20] + np.array([1.0, 0.0])  # a third has let go
    start = fitted(points, moved)
    motion = refine(points, moved, start, np.ones(60), 0.5, PITCH_PX, scale=False)
    assert motion.shift_px == pytest.approx((6.0, 0.0), abs=0.6)
    assert abs(start.shift_px[0] - 6.0) > 1.5


@given(st.integers(0, 1000), st.sampled_from([(7, 8), (9, 9), (12, 10)]), st.floats(0.0, 0.3))
def test_each_window_proposes_the_motion_that_fits_its_nodes_best(seed, shape, lost):
    """Windows of three nodes a side, of five on large grids, at every other node; seven in ten must be there."""
    rng, side = np.random.default_rng(seed), 5 if min(shape) >= 9 else 3
    before = np.stack(np.meshgrid(np.arange(shape[1]), np.arange(shape[0])), -1) * PITCH_PX
    after = twist(before, rng.uniform(-30, 30), rng.uniform(0, 100, 2)) + rng.normal(0, 1.0, before.shape)
    valid = rng.random(shape) >= lost
    expected = []
    for row in range(side // 2, shape[0], 2):
        for column in range(side // 2, shape[1], 2):
            window = np.s_[
                max(0, row - side // 2) : row + side // 2 + 1, max(0, column - side // 2) : column + side // 2 + 1
            ]
            there = valid[window]
            if there.sum() >= 0.7 * side * side:
                expected.append(fitted(before[window][there], after[window][there]))
    angles, shifts, centres = _window_motions(before, after, valid)
    assert angles == pytest.approx(np.array([one.angle_rad for one in expected]), abs=1e-9)
    assert shifts == pytest.approx(np.array([one.shift_px for one in expected]).reshape(-1, 2), abs=1e-9)
    assert centres == pytest.approx(np.array([one.pivot_px for one in expected]).reshape(-1, 2), abs=1e-9)


@given(st.floats(-10.0, 10.0), st.floats(3.0, 12.0), st.floats(-12.0, 12.0), st.integers(0, 100))
def test_the_moving_patch_is_the_largest_that_moves_as_one_however_much_rests(degrees, right_px, down_px, seed):
    rng = np.random.default_rng(seed)
    before = np.stack(np.meshgrid(np.arange(21), np.arange(20)), -1) * PITCH_PX + rng.normal(0, 0.3, (20, 21, 2))
    after, valid, middle = before.copy(), rng.random((20, 21)) > 0.05, (120.0, 105.0)
    after[4:11, 5:12] = twist(before[4:11, 5:12], degrees, middle, (right_px, down_px))
    after[14:, 15:] += (0.0, -right_px)  # a smaller one, elsewhere
    after[~valid] = np.nan
    motion = moving_patch(before, after, np.ones_like(valid), 0.45, PITCH_PX)
    assert np.degrees(motion.angle_rad) == pytest.approx(degrees, abs=1e-6)
    assert motion.apply(before[4:11, 5:12]) == pytest.approx(
        twist(before[4:11, 5:12], degrees, middle, (right_px, down_px))
    )


def test_a_grid_at_rest_or_of_too_few_nodes_has_no_moving_patch():
    before = np.stack(np.meshgrid(np.arange(9), np.arange(9)), -1) * PITCH_PX
    for valid in (np.ones((9, 9), bool), np.zeros((9, 9), bool), np.eye(9) > 0):
        motion = moving_patch(before, before, valid, 0.45, PITCH_PX)
        assert motion.apply(before) == pytest.approx(before)


@given(st.integers(0, 1000), st.sampled_from([(2, 3), (5, 6), (12, 10)]))
def test_the_carried_motion_is_the_tenth_largest_of_means_around_a_node(seed, shape):
    rng = np.random.default_rng(seed)
    moved, valid = rng.normal(0, 3.0, (*shape, 2)), rng.random(shape) > 0.3
    means = []
    for row, column in np.ndindex(*shape):
        around = np.s_[max(0, row - 1) : row + 2, max(0, column - 1) : column + 2]
        means.append(float(np.hypot(*(moved[around][valid[around]].sum(0) / max(1, valid[around].sum())))))
    assert carried_px(moved, valid) == pytest.approx(sorted(means)[-min(10, len(means))])
