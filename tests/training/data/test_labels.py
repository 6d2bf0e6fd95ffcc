import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulation.closed_loop import statistics
from training.data.labels import (
    CLASSES,
    HALF_TURN_SIGNS,
    MIRROR_SIGNS,
    SIGNS,
    THRESHOLD_THETA_DEG,
    THRESHOLD_X_MM,
    class_of,
)

ERRORS = st.tuples(st.floats(-15, 15, width=32), st.floats(-15, 15, width=32))


def name_of(x_mm, theta_deg):
    return CLASSES[int(class_of(np.array([x_mm, theta_deg], np.float32)))].name


@pytest.mark.parametrize(
    ("x_mm", "theta_deg", "name"),
    [
        (-8, 0, "1"),
        (8, 0, "2"),
        (-8, 8, "3"),
        (-8, -8, "4"),
        (8, 8, "5"),
        (8, -8, "6"),
        (0, -8, "7"),
        (0, 8, "8"),
        (2.5, -5, "near"),
    ],
)
def test_the_class_table_is_the_papers(x_mm, theta_deg, name):
    assert name_of(x_mm, theta_deg) == name


@given(ERRORS)
def test_signs_of_the_class_are_signs_of_the_error(error):
    signs = SIGNS[class_of(np.array(error, np.float32))]
    for sign, value, threshold in zip(signs, error, (2.5, 5.0), strict=True):
        assert sign == (np.sign(value) if abs(value) > threshold else 0)


@pytest.mark.parametrize(
    ("signs", "pairs"),
    [
        (MIRROR_SIGNS, {"1": "2", "3": "6", "4": "5", "7": "8", "near": "near"}),
        (HALF_TURN_SIGNS, {"1": "2", "3": "5", "4": "6", "7": "7", "8": "8", "near": "near"}),
    ],
)
def test_symmetries_map_the_classes_as_stated(signs, pairs):
    for x_mm in (-9.0, 0.0, 9.0):
        for theta_deg in (-9.0, 0.0, 9.0):
            before, after = name_of(x_mm, theta_deg), name_of(x_mm * signs[0], theta_deg * signs[1])
            assert pairs.get(before) == after or pairs.get(after) == before


def test_the_simulators_copy_of_the_classes_is_this_table():
    assert dict(statistics.SIGNS) == {entry.name: (entry.sign_x, entry.sign_theta) for entry in CLASSES}
    for x_mm in (-THRESHOLD_X_MM - 0.01, -THRESHOLD_X_MM, 0.0, THRESHOLD_X_MM + 0.01):
        for theta_deg in (-THRESHOLD_THETA_DEG - 0.01, 0.0, THRESHOLD_THETA_DEG, THRESHOLD_THETA_DEG + 0.01):
            assert statistics.class_of(x_mm, theta_deg) == name_of(x_mm, theta_deg)


def test_nan_labels_are_refused():
    with pytest.raises(ValueError, match="non-finite"):
        class_of(np.array([[np.nan, 1.0]], np.float32))
