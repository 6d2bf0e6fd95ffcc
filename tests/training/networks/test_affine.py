"""The fit of the object's motion as a whole: which motion of both fingers' markers gives which number."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from service.contract import Sensor
from training.networks.affine import NUMBERS, QUIET, AffineFit

WHOLE, PATCH = 0, 12
ALONG_X, ABOUT_Z, ALONG_Z = 0, 6, 7  # half the difference along u; half the sums along u and v
DV_ALONG_U, DU_ALONG_V = 3, 4  # of the difference: a turn about the fingers' axis is half of (3) - (4)
SIZE = 36
SENSOR = Sensor.load()
SHAPE = (SENSOR.marker_rows, SENSOR.marker_columns)
Motion = tuple[float, float, float]


def fields(left: Motion, right: Motion, rows: slice = slice(None)) -> Tensor:
    """Both fingers' (du, dv) and turn about the middle of the rows that move; every marker seen, the rest at rest."""
    made = torch.zeros(1, 2, 3, *SHAPE)
    made[:, :, 2] = 1.0
    v, u = torch.meshgrid(*(torch.linspace(-1, 1, count) for count in SHAPE), indexing="ij")
    for finger, (du, dv, turn) in enumerate((left, right)):
        made[0, finger, 0, rows] = (du - turn * (v - v[rows].mean()))[rows]
        made[0, finger, 1, rows] = (dv + turn * u)[rows]
    return made


def numbers(field: Tensor) -> Tensor:
    return AffineFit(8, SENSOR.marker_rows, SENSOR.marker_columns).raw(field)[0]


@given(du=st.floats(0.05, 0.5), dv=st.floats(-0.5, 0.5), part=st.sampled_from([slice(None), slice(4, 12)]))
def test_the_patch_that_moves_tells_the_objects_shift(du: float, dv: float, part: slice) -> None:
    features = numbers(fields((du, dv, 0.0), (-du, dv, 0.0), part))
    assert features[PATCH + ALONG_X] == pytest.approx(du, abs=1e-3)
    assert features[PATCH + ALONG_Z] == pytest.approx(dv, abs=1e-3)
    assert features[PATCH + ABOUT_Z] == pytest.approx(0.0, abs=1e-5)
    assert features[SIZE].exp() == pytest.approx((du**2 + dv**2) ** 0.5 + QUIET, abs=1e-3)


@given(turn=st.floats(0.05, 0.5))
def test_a_turn_about_the_fingers_is_what_they_see_with_opposite_signs(turn: float) -> None:
    features = numbers(fields((0.0, 0.0, turn), (0.0, 0.0, -turn)))
    assert features[WHOLE + DV_ALONG_U] == pytest.approx(turn, abs=1e-3)
    assert features[WHOLE + DU_ALONG_V] == pytest.approx(-turn, abs=1e-3)


def test_a_turn_about_the_vertical_is_what_both_fingers_see_alike_and_shows_before_it_is_large() -> None:
    for size in (1.0, 0.1):
        features = numbers(fields((0.1 * size, 2.0 * size, 0.0), (0.1 * size, 2.0 * size, 0.0)))
        assert features[PATCH + ABOUT_Z] == pytest.approx(0.1 * size, abs=1e-4)
        assert features[ALONG_X] == pytest.approx(0.0, abs=1e-5)
        assert features[2 * PATCH + ABOUT_Z] == pytest.approx(0.05, abs=0.006)


def test_what_was_not_seen_says_nothing() -> None:
    moved = fields((0.1, 0.3, 0.0), (-0.1, 0.3, 0.0))
    moved[:, :, 2, 3, 4] = 0.0
    moved[:, :, :2, 3, 4] = 0.0
    assert numbers(moved)[WHOLE + ALONG_Z] == pytest.approx(0.3, abs=1e-5)


def test_a_still_gel_gives_finite_numbers() -> None:
    features = numbers(fields((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
    assert len(features) == NUMBERS
    assert torch.isfinite(features).all()
    assert not features[:SIZE].any()
