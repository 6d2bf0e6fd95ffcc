"""Rubber that ends, keeps its volume, gives way in time, on fingers that bend: where theory knows the answer."""

import math

import numpy as np
import pytest
from scipy.sparse.linalg import LinearOperator, cg

from simulation.data.probe import QuasiStaticCell
from simulation.physics.bonded_block import EdgedLayer
from simulation.physics.elastic_layer import Grid, Kernel, bonded_layer
from simulation.physics.layer_pads import Relaxation
from simulation.physics.shape_factor import modulus_profile
from simulation.scene.worlds import load_scene
from tests.simulation.scenes import UPRIGHT

SIDE_MM, CELLS = 20.0, 16


def block(shape_factor: float, poisson: float) -> tuple[Kernel, float]:
    """A square block with free sides, and its thickness: loaded face over the area that is free to bulge."""
    thickness_mm = SIDE_MM / (4.0 * shape_factor)
    grid = Grid(CELLS, CELLS, SIDE_MM / CELLS, SIDE_MM / CELLS)
    return EdgedLayer(grid, thickness_mm, 1.0, poisson, (0.0, 0.0)), thickness_mm


def apparent_modulus(kernel: Kernel, thickness_mm: float, component: int) -> float:
    """Mean traction for a uniform displacement of the whole face (a bonded plate), times thickness over it."""
    shape = (CELLS, CELLS, 3)

    def moved(traction):
        return kernel(np.stack([traction.reshape(shape)] * 2))[0].ravel()

    load = np.zeros(shape)
    load[..., component] = 1.0
    traction, failed = cg(LinearOperator((load.size,) * 2, matvec=moved), load.ravel(), rtol=1e-6, maxiter=3000)
    assert not failed
    return float(traction.reshape(shape)[..., component].mean()) * thickness_mm


@pytest.mark.parametrize("poisson", [0.25, 0.4, 0.48, 0.495, 0.4999])
@pytest.mark.parametrize("shape_factor", [1.0, 2.0, 4.0])
def test_a_compressed_block_is_as_stiff_as_gent_meinecke_and_lindley_say(shape_factor: float, poisson: float) -> None:
    kernel, thickness_mm = block(shape_factor, poisson)
    middle = (np.arange(CELLS) + 0.5) * SIDE_MM / CELLS - 0.5 * SIDE_MM
    expected = modulus_profile(middle, middle, (0.5 * SIDE_MM, 0.5 * SIDE_MM), thickness_mm, poisson).mean()
    assert apparent_modulus(kernel, thickness_mm, 2) == pytest.approx(expected, rel=0.1)


@pytest.mark.parametrize("shape_factor", [1.0, 2.0, 3.0])
def test_rubber_that_keeps_its_volume_is_gent_and_lindleys_by_shape_factor(shape_factor: float) -> None:
    middle = (np.arange(CELLS) + 0.5) * SIDE_MM / CELLS - 0.5 * SIDE_MM
    thickness_mm = SIDE_MM / (4.0 * shape_factor)
    modulus = modulus_profile(middle, middle, (0.5 * SIDE_MM, 0.5 * SIDE_MM), thickness_mm, 0.4999).mean()
    assert modulus == pytest.approx(3.0 * (1.0 + 2.0 * shape_factor**2), rel=0.12)


@pytest.mark.parametrize("shape_factor", [1.0, 2.0, 4.0])
def test_a_sheared_block_with_free_ends_is_a_little_softer_than_without(shape_factor: float) -> None:
    """Rivlin and Saunders (1949): the block bends, too; 1 + t^2 / (36 k^2) with the radius of gyration k."""
    kernel, thickness_mm = block(shape_factor, 0.48)
    bends = 1.0 + thickness_mm**2 / (36.0 * SIDE_MM**2 / 12.0)
    modulus = apparent_modulus(kernel, thickness_mm, 0)
    assert modulus < 1.0
    assert modulus == pytest.approx(1.0 / bends, rel=0.06)


@pytest.mark.slow
@pytest.mark.parametrize("poisson", [0.25, 0.48])
def test_a_gel_whose_edges_are_far_is_endless(poisson: float) -> None:
    grid = Grid(20, 21, 1.05, 1.05)
    far, endless = EdgedLayer(grid, 2.5, 0.1, poisson, (100.0, 100.0)), bonded_layer(grid, 2.5, 0.1, poisson)
    tractions = np.random.default_rng(0).normal(size=(2, 20, 21, 3))
    for loaded in (tractions, np.ones_like(tractions) * (0.0, 0.0, 1.0), np.ones_like(tractions) * (1.0, 0.0, 0.0)):
        np.testing.assert_allclose(far(loaded), endless(loaded), atol=0.01 * np.abs(endless(loaded)).max())


@pytest.mark.parametrize("beyond_mm", [(0.0, 0.0), (0.4, 3.0)])
def test_a_gel_that_ends_is_reciprocal_and_stores_energy(beyond_mm: tuple[float, float]) -> None:
    kernel = EdgedLayer(Grid(9, 12, 1.0, 1.1), 2.5, 0.1, 0.48, beyond_mm)
    one, other = np.random.default_rng(1).normal(size=(2, 2, 9, 12, 3))
    assert np.sum(one * kernel(other)) == pytest.approx(np.sum(other * kernel(one)), rel=1e-9)
    assert np.sum(one * kernel(one)) > 0.0
    assert np.sum(one * kernel(one)) < np.sum(one * one) * max(kernel.largest_mm3_per_n) * 1.5


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_a_held_displacement_follows_pronys_step_response_exactly(share: float) -> None:
    held, one = np.array([0.3, -0.2]), Relaxation(share, 0.4)
    creep = np.zeros(2)
    for duration_s in (0.05, 0.2, 0.01, 0.34):
        creep = one.crept(creep, held, duration_s)
    np.testing.assert_allclose(held - creep, held * (1.0 - share * (1.0 - math.exp(-0.6 / 0.4))), rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("tier", ["bristle", "layer"])
def test_the_push_of_a_hand_that_waits_relaxes_as_the_rubber_does(tier: str) -> None:
    soft = {"gel__relaxation_share": 0.3, "gel__relaxation_s": 0.4, "gel__friction": 2.0, "effects__gravity": "off"}
    scene = load_scene("rectangle", gel__tier=tier, speed_mm_s=200.0, **soft, **UPRIGHT)
    cell = QuasiStaticCell(scene)
    cell.regrasp(0.0, 12.0)
    x, y, z, yaw = (float(value) for value in cell.pose)
    push = cell.move_to(x, y, z - 5.6, math.degrees(yaw)).wrench_n_nmm[2]
    for waited_s, passed_s in ((0.2, 0.2), (0.6, 0.8)):
        left = cell.wait(waited_s).wrench_n_nmm[2] / push
        assert left == pytest.approx(1.0 - 0.3 * (1.0 - math.exp(-passed_s / 0.4)), abs=0.01)


@pytest.mark.parametrize("tier", ["bristle", "layer"])
def test_fingers_give_by_the_force_on_their_pads_and_the_markers_ride_along(tier: str) -> None:
    played = {}
    for stiffness in (0.0, 20.0, 1e5):
        bend = {"grasp__finger_stiffness_n_per_mm": stiffness, "effects__finger_compliance": "on"}
        cell = QuasiStaticCell(load_scene("rectangle", gel__tier=tier, gel__friction=2.0, **bend, **UPRIGHT))
        cell.regrasp(8.0, 0.0)
        played[stiffness] = cell.move_to(cell.pose[0], 0.0, cell.pose[2] - 5.6, 0.0), cell
    bent, cell = played[20.0]
    sideways = 0.5 * bent.wrench_n_nmm[0]  # on each pad
    assert abs(sideways) > 0.5
    np.testing.assert_allclose(cell.layer._bent * (1.0, -1.0), sideways / 20.0, rtol=0.05)
    np.testing.assert_allclose(played[1e5][0].gel, played[0.0][0].gel, atol=2e-3)
    assert np.abs(bent.gel[..., 0] - played[0.0][0].gel[..., 0]).max() < 0.5 * abs(sideways / 20.0)
