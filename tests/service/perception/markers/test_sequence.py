"""Marker fields as networks read them: on the sensor's lattice, whichever part of it a tracker found."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.contract import Sensor
from service.perception.markers.field import MarkerField, empty_field, field_from_gel, marker_array
from service.perception.markers.sequence import track_pairs
from tests.service import tiny_models

SENSOR = Sensor.load()


def true_field(seed: int = 0) -> MarkerField:
    gel = np.random.default_rng(seed).normal(0, 0.05, (20, 21, 3))
    return field_from_gel(gel, 0, SENSOR)


@given(
    top=st.integers(0, 6),
    left=st.integers(0, 6),
    rows=st.integers(6, 14),
    columns=st.integers(6, 15),
    seed=st.integers(0, 9),
)
def test_a_part_of_the_grid_fills_its_part_of_the_lattice(top, left, rows, columns, seed) -> None:
    whole = true_field(seed)
    cut = np.s_[top : top + rows, left : left + columns]
    part = MarkerField(
        whole.rest_px[cut] + 2.0, whole.displacement_px[cut], whole.valid[cut], None, whole.pitch_px, 0, "partial"
    )
    expected = np.zeros((20, 21, 3), np.float32)
    expected[cut] = marker_array(whole, SENSOR.markers)[cut]
    assert np.array_equal(marker_array(part, SENSOR.markers), expected)


def test_a_gel_that_bulges_by_more_than_half_a_pitch_fills_every_node_of_the_lattice_once() -> None:
    """Nearest places would lay two markers on one node; a firm grasp of a curved object bulges by up to 10 px."""
    whole = true_field()
    middle = whole.rest_px.mean((0, 1))
    way = (whole.rest_px - middle) / 60.0
    bulge = 10.0 * 1.6 * way * np.exp(0.5 - 0.5 * np.square(way).sum(-1, keepdims=True))
    assert np.linalg.norm(bulge, axis=-1).max() > 7.5
    grid = SENSOR.markers
    for carried in (np.zeros(2), np.array([0.0, -14.0]), np.array([9.0, 20.0])):
        rest = (whole.rest_px + bulge + carried).astype(np.float32)
        assert np.array_equal(marker_array(replace(whole, rest_px=rest), grid), marker_array(whole, grid))


def test_no_grid_another_pitch_or_another_place_is_refused_by_name() -> None:
    field = true_field()
    coarse = MarkerField(field.rest_px, field.displacement_px, field.valid, None, 22.0, 0)
    away = MarkerField(field.rest_px + 400.0, field.displacement_px, field.valid, None, 15.0, 0)
    for wrong, word in ((empty_field(0, "no_grid", ""), "0 x 0"), (coarse, "22.0 px"), (away, "outside")):
        with pytest.raises(ValueError, match=word):
            marker_array(wrong, SENSOR.markers)


def test_pictures_without_markers_are_no_input_for_a_network_that_reads_markers(tmp_path) -> None:
    card = tiny_models.card("direction", "step").model_copy(update={"markers": SENSOR.markers})
    black = np.zeros((2, 2, 320, 327, 3), np.uint8)
    with pytest.raises(ValueError, match="expected 20 x 21"):
        track_pairs(black, SENSOR.markers, SENSOR.fps)
    assert card.input_shape == (20, 21, 3)
    for pair in (np.zeros((2, 20, 21, 3)), np.full((2, 20, 21, 3), np.nan, np.float32), black[0]):
        with pytest.raises(ValueError, match=r"float32|not finite"):
            card.check(pair)
