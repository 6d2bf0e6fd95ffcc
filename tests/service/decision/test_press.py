"""How long a press is, and what is felt of it."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.contract.model_card import Lattice
from service.decision.network_input import Descent, shows_press


def test_a_press_is_as_long_as_asked_and_as_the_gel_sticks_but_never_shorter_than_four_steps() -> None:
    pressing: Any = SimpleNamespace(steps_n=12, step_mm=0.1, lattice=None)
    frame = SimpleNamespace(width_px=10, height_px=10)
    card: Any = SimpleNamespace(pressing=pressing, frame=frame, profile=SimpleNamespace(mm_per_px=0.1))
    cases = [(0.8, None, 8), (0.8, 0.3, 6), (0.8, 0.45, 8), (0.8, 0.1, 4), (0.2, None, 4), (3.0, None, 12)]
    for press_mm, reach_mm, steps_n in cases:
        assert Descent(card, {"shear_reach_mm": reach_mm}, press_mm).worth_n == steps_n
    still = Descent(card, {"shear_reach_mm": 0.1}, 0.8, until_slip=True)
    assert (still.worth_n, still.enough, still.felt, still.pressed_mm) == (20, False, False, 0.0)


LATTICE = Lattice(rows=11, columns=15, pitch_mm=1.5)


@pytest.mark.parametrize(("axis", "points_n", "felt"), [(0, 10, True), (1, 10, True), (1, 9, False), (2, 99, False)])
def test_a_press_is_felt_where_ten_points_of_the_lattice_move_by_a_tenth_of_it(
    axis: int, points_n: int, felt: bool
) -> None:
    """Sideways or down, by either finger; that a point is seen is no motion. After 4 steps of 0.1 mm."""
    moved = np.zeros((2, LATTICE.rows, LATTICE.columns, 3), np.float32)
    moved.reshape(-1, 3)[:points_n, axis] = -0.041
    assert shows_press(moved, 0.4, LATTICE) == felt
    assert not shows_press(0.9 * moved, 0.4, LATTICE)


def carried_by(object_mm: np.ndarray, radius_mm: float) -> np.ndarray:
    """[rows, columns, 3]: the gel's motion where it touches an object that moves by [rows, columns, 2]."""
    touched = np.hypot(*np.moveaxis(LATTICE.points_mm, -1, 0)) <= radius_mm
    return np.concatenate([object_mm * touched[..., None], np.ones((*touched.shape, 1))], -1).astype(np.float32)


@given(turn_deg=st.floats(0.15, 2.0), side=st.sampled_from([-1.0, 1.0]), sag_mm=st.floats(0.0, 0.02))
def test_a_turn_in_a_small_contact_shows_a_press(turn_deg: float, side: float, sag_mm: float) -> None:
    """Five lattice points touch: too few for their motion to count, as with a wide light object in a soft gel."""
    u, v = np.moveaxis(LATTICE.points_mm, -1, 0)
    turned, sagged = side * math.radians(turn_deg) * np.stack([-v, u], -1), np.array([0.0, sag_mm])
    moved = np.stack([carried_by(sagged + turned, 1.6), carried_by(sagged - turned, 1.6)])
    assert shows_press(moved, 0.75, LATTICE)


@given(share=st.floats(0.0, 0.09), radius_mm=st.floats(1.6, 12.0))
def test_a_sag_is_no_press(share: float, radius_mm: float) -> None:
    sagged = carried_by(np.broadcast_to((0.0, 0.75 * share), LATTICE.points_mm.shape), radius_mm)
    assert not shows_press(np.stack([sagged, sagged]), 0.75, LATTICE)
