"""Marker fields as networks read them: on the sensor's lattice, whichever part of it a tracker found."""

from contextlib import nullcontext
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


@pytest.mark.parametrize(("times", "fits"), [(0.84, False), (0.86, True), (1.14, True), (1.16, False)])
def test_a_grid_is_another_sensors_if_its_pitch_is_off_by_more_than_15_percent(times: float, *, fits: bool) -> None:
    field = replace(true_field(), pitch_px=times * SENSOR.marker_pitch_px)
    with nullcontext() if fits else pytest.raises(ValueError, match="expected 20 x 21"):
        marker_array(field, SENSOR.markers)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(
    ("begins", "missing_n", "laid"),
    [
        (-2, 0, 0),
        (-3, 0, -3),
        (2, 0, 0),
        (3, 0, 3),
        (3, 2, 2),
        (4, 2, 2),
        (5, 2, 5),
        (1, 2, 1),
        (-1, 2, 0),
        (-3, 2, -3),
    ],
)
def test_a_grid_that_was_carried_by_two_pitches_lies_inside_its_lattice_and_one_further_out_does_not(
    axis: int, begins: int, missing_n: int, laid: int
) -> None:
    """``begins`` pitches beside the lattice's border, with ``missing_n`` rows or columns fewer."""
    whole = true_field()
    cut = [slice(None), slice(None)]
    cut[axis] = slice(0, whole.valid.shape[axis] - missing_n)
    part = tuple(cut)
    carried = np.zeros(2, np.float32)
    carried[1 - axis] = begins * SENSOR.marker_pitch_px
    field = replace(
        whole,
        rest_px=whole.rest_px[part] + carried,
        displacement_px=whole.displacement_px[part],
        valid=whole.valid[part],
    )
    rows = np.flatnonzero(marker_array(field, SENSOR.markers)[..., 2].any(1 - axis))
    sides_n = whole.valid.shape[axis]
    assert rows.tolist() == [k for k in range(laid, laid + sides_n - missing_n) if 0 <= k < sides_n]


@pytest.mark.parametrize(("begins", "inside"), [(-10, True), (-11, False), (10, True), (11, False)])
def test_a_grid_half_of_whose_markers_lie_outside_the_lattice_is_refused(begins: int, *, inside: bool) -> None:
    whole = true_field()
    away = replace(whole, rest_px=whole.rest_px + np.float32([0.0, begins * SENSOR.marker_pitch_px]))
    with nullcontext() if inside else pytest.raises(ValueError, match="outside the lattice"):
        marker_array(away, SENSOR.markers)


def test_pictures_without_markers_are_no_input_for_a_network_that_reads_markers(tmp_path) -> None:
    card = tiny_models.card("direction", "step").model_copy(update={"markers": SENSOR.markers})
    black = np.zeros((2, 2, 320, 327, 3), np.uint8)
    with pytest.raises(ValueError, match="expected 20 x 21"):
        track_pairs(black, SENSOR.markers, SENSOR.fps)
    assert card.input_shape == (20, 21, 3)
    for pair in (np.zeros((2, 20, 21, 3)), np.full((2, 20, 21, 3), np.nan, np.float32), black[0]):
        with pytest.raises(ValueError, match=r"float32|not finite"):
            card.check(pair)
