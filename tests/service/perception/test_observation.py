"""Limits of what one frame says by itself."""

from dataclasses import replace

import numpy as np
import pytest

from service.perception.markers.field import empty_field
from service.perception.observation import Observation
from service.perception.slip.detector import SlipDetector
from tests.service.perception.synthetic import patch_fields, rigid

FIELD = patch_fields(rigid(), frames=1)[0][0]
SLIP = SlipDetector().rearm(FIELD)
PLAIN = Observation("left", 0, 0, np.zeros((2, 2, 3), np.uint8), FIELD, SLIP, None, {})


@pytest.mark.parametrize(
    ("bulge", "touch", "feels"),
    [(None, None, False), (None, 2.0, False), (0.99, None, False), (1.0, None, True), (0.3, 1.0, True)],
)
def test_a_gel_is_touched_from_one_on_by_markers_or_picture(bulge, touch, feels):
    assert replace(PLAIN, bulge=bulge, touch=touch).feels is feels


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
