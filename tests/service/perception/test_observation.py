"""Limits of what one frame says by itself."""

from dataclasses import replace

import numpy as np
import pytest

from service.perception.markers.field import empty_field
from service.perception.observation import Observation, PairObservation
from service.perception.slip.detector import SlipDetector
from tests.service.perception.synthetic import patch_fields, rigid

FIELD = patch_fields(rigid(), frames=1, noise_px=0.0)[0][0]
SLIP = SlipDetector().rearm(FIELD)
PLAIN = Observation("left", 0, 0, np.zeros((2, 2, 3), np.uint8), FIELD, SLIP, None, {})


@pytest.mark.parametrize(
    ("bulge", "touch", "feels"),
    [(None, None, False), (None, 2.0, False), (0.99, None, False), (1.0, None, True), (0.3, 1.0, True)],
)
def test_a_gel_is_touched_from_one_on_by_markers_or_picture(bulge, touch, feels):
    assert replace(PLAIN, bulge=bulge, touch=touch).feels is feels


@pytest.mark.parametrize(
    ("bulge", "touch", "felt"), [(None, 2.0, None), (0.02, None, 0.02), (0.02, 0.5, 0.5), (0.7, 0.5, 0.7)]
)
def test_a_touch_is_as_strong_as_the_stronger_of_markers_and_picture_say(bulge, touch, felt):
    assert replace(PLAIN, bulge=bulge, touch=touch).felt == felt


@pytest.mark.parametrize(
    ("field", "state", "says"),
    [
        (FIELD, "hold", True),
        (FIELD, "slip", True),
        (FIELD, "unknown", False),
        (FIELD, "lost", False),
        (replace(FIELD, status="partial"), "hold", True),
        (replace(FIELD, status="duplicate"), "hold", False),
        (empty_field(0, "no_grid", "black"), "hold", False),
    ],
)
def test_a_frame_says_something_of_slip_if_its_markers_are_new_and_were_compared(field, state, says):
    assert replace(PLAIN, field=field, slip=replace(SLIP, state=state)).informative is says


def test_both_fingers_markers_are_where_they_rest_and_how_they_moved_where_they_were_found():
    moved = replace(FIELD, displacement_px=np.full_like(FIELD.displacement_px, 2.0), valid=FIELD.valid.copy())
    moved.valid[3, 4] = False
    places = pair(moved).markers_px()
    assert np.isnan(places[1, 3, 4]).all()
    assert np.array_equal(places[1, 0, 0], FIELD.rest_px[0, 0] + 2.0)
    assert np.array_equal(places[0], FIELD.rest_px)
    assert places.dtype == np.float32


def test_fingers_with_different_grids_are_named():
    assert pair(FIELD).unlike_grids() == ""
    (small,) = patch_fields(rigid(), frames=1, rows=19)[0]
    assert pair(small).unlike_grids() == "the fingers show different grids: left 21 x 20 markers, right 21 x 19"


def pair(right):
    return PairObservation(PLAIN, replace(PLAIN, finger="right", field=right))
