"""The rigid motion of a few points: exact where it is determined, none where it is not."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.perception.slip.rigid import fit_motion, refine
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
