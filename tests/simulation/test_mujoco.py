"""An independent engine on the same pokes: contact force and rotation in the hand. docs/mujoco.md has the figures."""

import numpy as np
import pytest

from tests.simulation.mujoco_bench import COARSE, SCENES, compare, ours, press

FLAT = [scene for scene in SCENES if scene[0] in {"rectangle", "hexagon", "white_box"}]
CURVED = [scene for scene in SCENES if scene not in FLAT]


def test_a_quick_mujoco_run_agrees_within_two_percent() -> None:
    cell, mine = ours("hexagon", 10.0, 0.0, 0.17)
    theirs = press(cell, 10.0, 0.0, COARSE)
    np.testing.assert_allclose(theirs.force_n, mine.force_n, atol=0.02 * np.linalg.norm(mine.force_n))
    np.testing.assert_allclose(theirs.turn_deg, mine.turn_deg, atol=0.02 * np.linalg.norm(mine.turn_deg))


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(("name", "x_mm", "theta_deg"), FLAT)
def test_flat_held_objects_agree_within_the_sum_of_both_refinement_errors(name, x_mm, theta_deg) -> None:
    assert compare(name, x_mm, theta_deg).agree


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(("name", "x_mm", "theta_deg"), CURVED)
def test_round_held_objects_agree_less_well(name, x_mm, theta_deg) -> None:
    found = compare(name, x_mm, theta_deg)
    assert found.force_apart_n < 0.4
    assert found.turn_apart_deg < 0.02
