"""An independent engine on the same pokes: contact force and rotation in the hand."""

import numpy as np
import pytest

from tests.simulation.physics.mujoco.bench import COARSER, LOAD_STEPS_MM, compare, ours, theirs
from tests.simulation.physics.mujoco.scenes import POKES, Poke

AGREEING = [poke for poke in POKES if poke.agrees]
OTHERS = [poke for poke in POKES if not poke.agrees]


def named(poke: Poke) -> str:
    return f"{poke.scene} {poke.x_mm:g}, {poke.theta_deg:g}, {poke.varied}, tips apart: {poke.apart}"


@pytest.mark.slow
def test_a_quick_mujoco_run_agrees_within_a_hundredth() -> None:
    poke = Poke("hexagon", 10.0, 0.0)
    cell, mine = ours(poke, LOAD_STEPS_MM[0])
    other = theirs(poke, cell, COARSER[0])
    np.testing.assert_allclose(other.force_n, mine.force_n, atol=0.01 * np.linalg.norm(mine.force_n))
    np.testing.assert_allclose(other.turn_deg, mine.turn_deg, atol=0.01 * np.linalg.norm(mine.turn_deg))


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("poke", AGREEING, ids=named)
def test_both_engines_agree_within_the_sum_of_their_refinement_errors(poke: Poke) -> None:
    assert compare(poke).agree


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("poke", OTHERS, ids=named)
def test_where_they_do_not_they_are_within_a_few_hundredths(poke: Poke) -> None:
    comparison = compare(poke)
    assert comparison.force_apart_n < 0.05 * comparison.force_n
    assert comparison.turn_apart_deg < 0.01 * comparison.turn_deg
