"""Statistics over a grid's neighbours, against plain loops, and fields of the simulator."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.contract import Sensor
from service.perception.markers.field import field_from_gel, median, neighbour_mean, neighbour_median


def neighbours(values: np.ndarray, valid: np.ndarray, row: int, column: int) -> np.ndarray:
    """Values [n, 2] of the up to eight valid nodes around one."""
    rows, columns = np.mgrid[0 : valid.shape[0], 0 : valid.shape[1]]
    apart = np.maximum(abs(rows - row), abs(columns - column))
    return np.asarray(values[(apart == 1) & valid])


@given(st.integers(0, 10_000), st.floats(0.0, 1.0))
def test_mean_and_median_of_the_neighbours_are_those_of_the_valid_ones(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(5, 6, 2)).astype(np.float32)
    valid = rng.random((5, 6)) < share
    mean, (middle, count) = neighbour_mean(values, valid), neighbour_median(values, valid)
    for row, column in np.ndindex(5, 6):
        around = neighbours(values, valid, row, column)
        assert count[row, column] == len(around)
        if len(around):
            assert mean[row, column] == pytest.approx(around.mean(0), abs=1e-5)
            assert middle[row, column] == pytest.approx(np.median(around, 0), abs=1e-6)
        else:
            assert not mean[row, column].any()
            assert not middle[row, column].any()


@given(st.integers(1, 30), st.integers(0, 1000))
def test_a_median_is_numpys(n: int, seed: int) -> None:
    values = np.random.default_rng(seed).normal(size=(n, 2))
    assert np.array_equal(median(values), np.median(values, axis=0))


def test_a_simulated_gel_is_a_field_in_pixels_whose_pressed_nodes_touch() -> None:
    sensor = Sensor.load()
    gel = np.zeros((sensor.marker_rows, sensor.marker_columns, 3), np.float32)
    gel[2, 3], gel[4, 5], gel[6, 7] = (0.1, -0.2, 0.01), np.nan, (0.0, 0.0, 5e-5)
    field = field_from_gel(gel, 7, sensor)
    px_per_mm = sensor.marker_pitch_px / sensor.marker_pitch_mm
    assert field.displacement_px[2, 3] == pytest.approx((0.1 * px_per_mm, -0.2 * px_per_mm))
    assert (field.contact.sum(), field.contact[2, 3], field.captured_ns) == (1, True, 7)
    assert (field.valid.sum(), field.valid[4, 5]) == (field.valid.size - 1, False)
    with pytest.raises(ValueError, match="gel is"):
        field_from_gel(gel[1:], 7, sensor)
