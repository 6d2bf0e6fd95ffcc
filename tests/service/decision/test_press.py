"""How long a press is, and what is felt of it."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from service.decision.network_input import Descent


def test_a_press_is_as_long_as_asked_and_as_the_gel_sticks_but_never_shorter_than_four_steps() -> None:
    pressing: Any = SimpleNamespace(steps_n=12, step_mm=0.1, lattice=None)
    frame = SimpleNamespace(width_px=10, height_px=10)
    card: Any = SimpleNamespace(pressing=pressing, frame=frame, profile=SimpleNamespace(mm_per_px=0.1))
    cases = [(0.8, None, 8), (0.8, 0.3, 6), (0.8, 0.45, 8), (0.8, 0.1, 4), (0.2, None, 4), (3.0, None, 12)]
    for press_mm, reach_mm, steps_n in cases:
        assert Descent(card, {"shear_reach_mm": reach_mm}, press_mm).worth_n == steps_n
    still = Descent(card, {"shear_reach_mm": 0.1}, 0.8, until_slip=True)
    assert (still.worth_n, still.enough, still.felt, still.pressed_mm) == (20, False, False, 0.0)


@pytest.mark.parametrize(("axis", "points_n", "felt"), [(0, 10, True), (1, 10, True), (1, 9, False), (2, 99, False)])
def test_a_press_is_felt_where_ten_points_of_the_lattice_move_by_a_tenth_of_it(
    axis: int, points_n: int, felt: bool
) -> None:
    """Sideways or down, by either finger; that a point is seen is no motion. After 4 steps of 0.1 mm."""
    shown = Descent.__new__(Descent)
    shown._steps = SimpleNamespace(steps_n=4, spec=SimpleNamespace(step_mm=0.1))  # type: ignore[assignment]
    shown._last = np.zeros((2, 10, 10, 3), np.float32)
    shown._last.reshape(-1, 3)[:points_n, axis] = -0.041
    assert shown.felt == felt
    shown._last *= 0.9
    assert not shown.felt
