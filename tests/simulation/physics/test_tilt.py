"""A tilted hand holds the object tilted: the same object as one that was gripped askew, and the weight pulls down."""

import math

import numpy as np
import pytest

from simulation.foreign.cell import ForeignCell
from simulation.physics.quasistatic import QuasiStaticCell
from simulation.scene.worlds import load_scene
from tests.simulation.scenes import UPRIGHT

CELLS = [(QuasiStaticCell, "bristle"), (QuasiStaticCell, "layer"), (ForeignCell, "bristle")]


def held(make, tier, **changes):
    cell = make(load_scene("rectangle", gel__tier=tier, **UPRIGHT, **changes), 0)
    cell.regrasp(8.0, 5.0)
    return cell


def leans_deg(cell):
    """How far the object leans towards a block, by its own x axis."""
    turn, _ = cell._world() if isinstance(cell, QuasiStaticCell) else cell.bodies.pose(cell.grip)
    return -math.degrees(math.asin(turn[2, 0]))


@pytest.mark.parametrize(("make", "tier"), CELLS)
def test_the_object_turns_with_the_hand_and_the_gels_do_not_show_it(make, tier):
    cell = held(make, tier)
    before = cell.look()
    after = cell.tilt_to(1.0)
    low_mm = cell.scene.grasp.height_mm * math.tan(math.radians(1.0))
    assert after.object_error[0] == pytest.approx(before.object_error[0] - low_mm, abs=0.02)
    assert after.bottom_z_mm < before.bottom_z_mm
    assert np.array_equal(after.gel, before.gel)
    again = cell.tilt_to(0.0)
    assert again.bottom_z_mm == pytest.approx(before.bottom_z_mm, abs=1e-9)


@pytest.mark.parametrize(("make", "tier"), CELLS)
def test_a_tilt_undoes_what_an_attempt_has_turned(make, tier):
    cell = held(make, tier, gel__friction=0.5)
    x, y, z, yaw = cell.pose
    cell.move_to(x, y, z - 6.5, math.degrees(yaw))
    free = cell.move_to(x, y, z, math.degrees(yaw))
    turned_deg = math.degrees(free.in_hand[4])
    assert abs(turned_deg) > 0.3
    assert leans_deg(cell) == pytest.approx(turned_deg, abs=0.02)
    cell.tilt_to(-turned_deg)
    assert leans_deg(cell) == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize(("make", "tier"), CELLS[::2])
def test_the_weight_pulls_down_whichever_way_the_hand_tilts(make, tier):
    cell = held(make, tier, object__mass_kg=0.3)
    weight_n = 0.3 * 9.81
    for angle_deg in (0.0, 20.0, -20.0):
        cell.tilt_to(angle_deg)
        cell._advance(cell.pose.copy())
        force = cell.look().wrench_n_nmm[:3]
        expected = -weight_n * np.array([-math.sin(math.radians(angle_deg)), 0.0, math.cos(math.radians(angle_deg))])
        assert force == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize("make", [QuasiStaticCell, ForeignCell])
def test_an_object_that_touches_a_block_is_not_tilted(make):
    cell = held(make, "bristle")
    x, y, z, yaw = cell.pose
    cell.move_to(x, y, z - 5.6, math.degrees(yaw))
    with pytest.raises(ValueError, match="touches nothing"):
        cell.tilt_to(0.5)
    cell.move_to(x, y, z, math.degrees(yaw))
    with pytest.raises(ValueError, match="finite"):
        cell.tilt_to(math.nan)
    cell.tilt_to(0.5)
    cell.regrasp(0.0, 0.0)
    assert cell.tilt_rad == 0.0
