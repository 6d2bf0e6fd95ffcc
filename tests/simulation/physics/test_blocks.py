"""Free blocks against textbook statics: a pushed block slides at mu W, or tips about its far edge at W b / (2 h)."""

import numpy as np
import pytest

from simulation.data.probe import CellState, QuasiStaticCell
from simulation.scene.worlds import load_scene
from tests.simulation.scenes import UPRIGHT

WIDTH_MM, HEIGHT_MM, WEIGHT_N = 20.0, 100.0, 0.6 * 9.81
DEEP_MM = 7.0
TIPS_ABOVE = WIDTH_MM / (2.0 * HEIGHT_MM)


def push(table_friction: float) -> CellState:
    """The object DEEP_MM deep in the gap, pushed sideways 5 mm, half of it clearance, against the tall right block."""
    scene = load_scene(
        "rectangle",
        blocks__free=True,
        blocks__size_x_mm=WIDTH_MM,
        blocks__height_mm=HEIGHT_MM,
        blocks__mass_kg=0.6,
        blocks__friction=0.0,
        blocks__table_friction=table_friction,
        **UPRIGHT,
    )
    cell = QuasiStaticCell(scene)
    cell.regrasp(0.0, 0.0)
    x, y, z, _ = cell.pose
    cell.move_to(x, y, z - 5.0 - DEEP_MM, 0.0)
    state = cell.look()
    for way in np.linspace(0.5, 5.0, 10):
        state = cell.move_to(x + way, y, z - 5.0 - DEEP_MM, 0.0)
    return state


@pytest.mark.parametrize("table_friction", [0.02, 0.3 * TIPS_ABOVE, 0.7 * TIPS_ABOVE])
def test_a_block_on_a_slippery_table_slides_at_the_friction_force(table_friction: float) -> None:
    state = push(table_friction)
    assert -state.wrench_n_nmm[0] == pytest.approx(table_friction * WEIGHT_N, rel=0.01)
    assert state.block_motion[0, 0] > 2.3
    assert state.block_motion[0, 3] < 0.02


@pytest.mark.parametrize("table_friction", [2.0 * TIPS_ABOVE, 2.0])
def test_a_block_on_a_rough_table_tips_about_its_far_edge(table_friction: float) -> None:
    state = push(table_friction)
    tilt = np.radians(state.block_motion[0, 3])
    assert 1.3 < np.degrees(tilt) < np.degrees(2.5 / (HEIGHT_MM - DEEP_MM))
    lever = 0.5 * (WIDTH_MM * np.cos(tilt) - HEIGHT_MM * np.sin(tilt))
    assert -state.wrench_n_nmm[0] == pytest.approx(
        WEIGHT_N * lever / (HEIGHT_MM - DEEP_MM), rel=0.02
    )  # a wall that leans away is touched low
    assert np.abs(state.block_motion[1]).max() < 1e-3
