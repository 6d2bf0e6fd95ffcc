"""The layer tier where theory knows the answer, always through the whole cell: grasp, equilibrium, pads.

Hertz and Mindlin: the held object is flat, the pads are paraboloids, and gravity is the tangential load.
"""

import math

import numpy as np
import pytest
from scipy.linalg import expm

from simulation.data.probe import CellState, QuasiStaticCell, run_probe
from simulation.physics import elastic_layer
from simulation.physics.quasistatic import PhysicsError
from simulation.scene.scene import SceneError
from simulation.scene.worlds import load_scene
from tests.simulation.physics import theory
from tests.simulation.physics.half_space import half_space
from tests.simulation.scenes import UPRIGHT


def test_pressure_and_partial_slip_on_a_half_space_follow_hertz_cattaneo_and_mindlin() -> None:
    cell = theory.hang(64, "layer")
    assert cell._grips() == pytest.approx(theory.FORCE_N, rel=1e-5)
    for compared in theory.half_space(64, cell):
        assert compared.error < compared.limit, compared.what
    a = (3.0 * theory.FORCE_N * theory.CURVATURE_MM / 16.0) ** (1.0 / 3.0)
    c = a * (1.0 - theory.LOAD_N / (theory.FRICTION * theory.FORCE_N)) ** (1.0 / 3.0)
    slipped, r = cell.nodes["slipped"] > 0, np.hypot(cell.nodes["x"], cell.nodes["z"])
    assert np.all(r[slipped] > 0.9 * c)
    assert np.all(r[(cell.nodes["pressure"] > 0) & ~slipped] < 1.1 * c)


def test_a_sheared_paraboloid_on_bristles_sticks_where_winkler_says() -> None:
    cell = theory.hang(64, "bristle", modulus_n_per_mm2=0.5)
    for compared in theory.winkler(64, cell):
        assert compared.error < compared.limit, compared.what
    a = (4.0 * theory.FORCE_N * theory.CURVATURE_MM / (math.pi * float(cell.constants["kn"][0]))) ** 0.25
    assert a < 0.5 * theory.WIDTH_MM
    c = a * (1.0 - theory.LOAD_N / (theory.FRICTION * theory.FORCE_N)) ** 0.25
    slipped, r = cell.nodes["slipped"] > 0, np.hypot(cell.nodes["x"], cell.nodes["z"])
    assert np.abs(r[slipped] - c).min() < 2.0 * theory.WIDTH_MM / 64
    assert np.all(r[slipped] > 0.98 * c)


@pytest.mark.parametrize("poisson", [0.0, 0.25, 0.45, 0.499])
@pytest.mark.parametrize("wave", [0.05, 0.4, 1.0, 2.0])
def test_the_layers_compliance_solves_naviers_equations(poisson: float, wave: float) -> None:
    """Sagittal waves: d/dz of (ux, uz, sxz, szz) is linear, so the layer is one matrix exponential from its back."""
    shear, thickness = 0.2, 1.3
    lame = 2.0 * shear * poisson / (1.0 - 2.0 * poisson)
    m = lame + 2.0 * shear
    rates = np.zeros((4, 4), complex)
    rates[0, 1], rates[0, 2] = -1j * wave, 1.0 / shear
    rates[1, 0], rates[1, 3] = -1j * wave * lame / m, 1.0 / m
    rates[2, 0], rates[2, 3] = wave**2 * (m - lame**2 / m), -1j * wave * lame / m
    rates[3, 2] = -1j * wave
    through = expm(rates * thickness)
    exact = through[:2, 2:] @ np.linalg.inv(through[2:, 2:])  # up is positive there, into the pad here
    compliance = elastic_layer.layer_compliance(np.array([wave]), np.array([0.0]), thickness, shear, poisson)[..., 0]
    np.testing.assert_allclose(compliance[0, 0], exact[0, 0], rtol=1e-9)
    np.testing.assert_allclose(compliance[2, 2], exact[1, 1], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(compliance[0, 2], -exact[0, 1], rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(compliance[2, 0], -exact[1, 0], rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(compliance[1, 1], math.tanh(wave * thickness) / (shear * wave), rtol=1e-9)


def test_a_thick_layer_is_a_half_space() -> None:
    grid = elastic_layer.Grid(12, 14, 0.9, 1.1)
    thick, half = elastic_layer.bonded_layer(grid, 30.0, 0.3, 0.3), half_space(grid, 0.3, 0.3)
    rng = np.random.default_rng(0)
    tractions = rng.normal(size=(2, 12, 14, 3))
    tractions -= tractions.mean((1, 2), keepdims=True)
    np.testing.assert_allclose(thick(tractions), half(tractions), atol=0.01 * np.abs(half(tractions)).max())


@pytest.mark.parametrize(
    "make", [lambda g: elastic_layer.bonded_layer(g, 2.5, 0.1, 0.45), lambda g: half_space(g, 1, 0)]
)
def test_a_kernel_is_reciprocal_and_stores_energy(make) -> None:
    kernel = make(elastic_layer.Grid(9, 12, 1.0, 1.0))
    one, other = np.random.default_rng(1).normal(size=(2, 2, 9, 12, 3))
    assert np.sum(one * kernel(other)) == pytest.approx(np.sum(other * kernel(one)), rel=1e-9)
    assert np.sum(one * kernel(one)) > 0.0


def poke(tier: str, name: str = "rectangle", **changes: float) -> CellState:
    cell = QuasiStaticCell(load_scene(name, gel__tier=tier, **UPRIGHT, **changes))
    cell.regrasp(8.0, 5.0)
    return cell.move_to(cell.pose[0], 0.0, cell.pose[2] - 6.2, 5.0)


@pytest.mark.parametrize("name", ["rectangle", "circle"])
def test_a_thin_layer_is_a_bed_of_bristles(name: str) -> None:
    thin = {"gel__thickness_mm": 0.3, "grasp__force_n": 10.0, "gel__crown_mm": 0.1}
    bristles, pads = (poke(tier, name, effects__gel_coupling="off" if tier == "bristle" else "auto", **thin)
                      for tier in ("bristle", "layer"))  # fmt: skip
    assert theory.relative(pads.wrench_n_nmm, bristles.wrench_n_nmm) < 0.03
    assert theory.relative(pads.in_hand, bristles.in_hand) < 0.01
    assert theory.relative(pads.gel[..., :2], bristles.gel[..., :2]) < 0.06


def test_a_probe_runs_on_either_tier_and_a_thick_gel_tells_them_apart() -> None:
    probes = {tier: run_probe(load_scene("hexagon", gel__tier=tier), 8.0, 5.0, seed=2) for tier in ("bristle", "layer")}
    assert {probe.outcome for probe in probes.values()} == {"blocked"}
    assert probes["layer"].gel.shape == probes["bristle"].gel.shape
    assert probes["layer"].wrench[:, 2].max() == pytest.approx(probes["bristle"].wrench[:, 2].max(), rel=0.3)
    assert theory.relative(probes["layer"].gel[-1], probes["bristle"].gel[-1]) > 0.02


def test_the_layers_equilibrium_is_as_exact_as_the_bristles() -> None:
    cell = QuasiStaticCell(load_scene("ellipse", gel__tier="layer"))
    cell.regrasp(8.0, 5.0)
    for depth in (5.5, 6.0, 6.5):
        state = cell.move_to(cell.pose[0], 0.0, 35.0 - depth, 5.0)
        assert state.residual_n <= 1e-6
        assert cell.state["report"][4] <= 1e-9
        assert np.all(cell.nodes["pressure"] >= 0.0)
    again = cell.layer.kernel(cell.layer._tractions())
    np.testing.assert_allclose(again, cell.layer.surface, atol=1e-9)


def test_an_object_held_at_a_corner_keeps_its_equilibrium_while_it_is_pressed() -> None:
    """Soft bristles let it buckle in mid-iteration, so the step has to be taken again with stiffer ones."""
    scene = load_scene(
        "rectangle",
        object__shape="polygon",
        object__vertices_mm=((30.0, -22.0), (30.0, 15.0), (0.0, 38.0), (-30.0, 15.0), (-30.0, -22.0)),
        object__size_x_mm=60.0,
        object__size_y_mm=60.0,
        object__mass_kg=0.12,
        blocks__gap_mm=64.0,
        gel__tier="layer",
        gel__poisson_ratio=0.48,
        gel__margin_mm=(0.5, 0.5),
        grasp__height_mm=30.0,
    )
    cell = QuasiStaticCell(scene)
    cell.regrasp(7.1, -2.2)
    for depth_mm in np.arange(0.2, 1.5, 0.2):  # at 1 mm it slides
        state = cell.move_to(cell.pose[0], 0.0, 30.0 - depth_mm, math.degrees(cell.pose[3]))
        assert state.residual_n <= 1e-6
        assert state.in_contact
        assert not cell.grasp_lost
    np.testing.assert_allclose(cell.layer.kernel(cell.layer._tractions()), cell.layer.surface, atol=1e-9)


def test_the_layer_tier_refuses_what_it_cannot_be() -> None:
    with pytest.raises(SceneError, match=r"gel\.normal_ratio"):
        load_scene("rectangle", gel__tier="layer", gel__normal_ratio=1.0)
    with pytest.raises(SceneError, match=r"effects\.gel_coupling"):
        load_scene("rectangle", gel__tier="layer", effects__gel_coupling="on")
    with pytest.raises(ValueError, match="thickness"):
        elastic_layer.bonded_layer(elastic_layer.Grid(4, 4, 1.0, 1.0), 0.0, 0.1, 0.3)
    with pytest.raises(ValueError, match="Poisson"):
        elastic_layer.bonded_layer(elastic_layer.Grid(4, 4, 1.0, 1.0), 2.5, 0.1, 0.6)
    with pytest.raises(PhysicsError, match=r"grasp\.force_n"):
        QuasiStaticCell(load_scene("ellipse", gel__tier="layer", grasp__force_n=120.0, gel__thickness_mm=0.5))
