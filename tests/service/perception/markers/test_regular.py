"""Regularity of a grid: a lens bends the whole print, a grip only a part of it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.perception.markers.field import MarkerField
from service.perception.markers.regular import irregular_pitch

ROWS, COLUMNS, PITCH_PX = 9, 11, 30.0


def grid(
    bent_px: np.ndarray | float = 0.0, valid: np.ndarray | None = None, *, status: str = "tracking"
) -> MarkerField:
    v, u = np.mgrid[0:ROWS, 0:COLUMNS].astype(np.float32) * PITCH_PX
    moved = np.broadcast_to(np.asarray(bent_px, np.float32), (ROWS, COLUMNS, 2))
    measured = np.ones((ROWS, COLUMNS), bool) if valid is None else valid
    return MarkerField(np.stack([u, v], -1), moved, measured, None, PITCH_PX, 0, status)


def through_a_lens(shift, turn_rad, scale, tilt, k1, k2) -> np.ndarray:
    """What a turned, tilted print looks like through a lens, less its places in the grid, px."""
    half_px = (COLUMNS - 1) / 2 * PITCH_PX
    places = grid().rest_px.astype(float)
    off = (places - places.reshape(-1, 2).mean(0)) / half_px
    r2 = np.square(off).sum(-1, keepdims=True)
    bent = off * (1 + k1 * r2 + k2 * r2**2 + off @ np.array(tilt)[:, None])
    cos, sin = scale * np.cos(turn_rad), scale * np.sin(turn_rad)
    return np.asarray(bent @ np.array([[cos, sin], [-sin, cos]]) * half_px + shift - off * half_px)


SMALL = st.floats(-0.15, 0.15)


@given(st.tuples(SMALL, SMALL), st.floats(-3.0, 3.0), st.floats(0.8, 1.2), st.tuples(SMALL, SMALL), SMALL, SMALL)
def test_a_print_through_any_lens_is_regular(shift, turn_rad, scale, tilt, k1, k2):
    assert irregular_pitch(grid(through_a_lens(shift, turn_rad, scale, tilt, k1, k2))) < 1e-4


def test_noise_is_as_irregular_as_it_is_large():
    """Squares of both coordinates are exponential; ten terms take their share, the worst twentieth does not count."""
    noise_px = 0.1 * PITCH_PX * np.random.default_rng(0).normal(size=(ROWS, COLUMNS, 2))
    without_worst = 1 - 0.05 / 0.95 * np.log(20)
    expected = 0.1 * (2 * (1 - 10 / (ROWS * COLUMNS)) * without_worst) ** 0.5
    assert irregular_pitch(grid(noise_px)) == pytest.approx(expected, rel=0.07)


def test_a_worn_marker_is_no_irregularity_and_a_dent_is():
    worn, dent = np.zeros((ROWS, COLUMNS, 2)), np.zeros((ROWS, COLUMNS, 2))
    worn[4, 5] = 0.5 * PITCH_PX
    dent[3:6, 4:7, 1] = 0.5 * PITCH_PX
    assert irregular_pitch(grid(worn)) < 0.03
    assert irregular_pitch(grid(dent)) > 0.05


def test_too_few_markers_or_a_lost_grid_tell_nothing():
    some = np.zeros((ROWS, COLUMNS), bool)
    some.flat[:20] = True
    assert np.isfinite(irregular_pitch(grid(valid=some)))
    some.flat[0] = False
    assert irregular_pitch(grid(valid=some)) == np.inf
    assert irregular_pitch(grid(status="lost")) == np.inf
