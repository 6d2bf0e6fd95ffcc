"""Guarantees of the solver: residuals, friction cones, memory, determinism, and typed failures."""

import dataclasses
import hashlib
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

from simulation.data.probe import QuasiStaticCell, run_probe
from simulation.scene.worlds import load_scene
from simulation.studies.hard_probes import ImpossibleStateError, Tally, _check, run
from tests.simulation.scenes import UPRIGHT


@pytest.mark.slow
def test_an_object_that_snaps_over_in_soft_fingers_ends_in_an_equilibrium(tmp_path: Path) -> None:
    changes = {
        "gel.relaxation_share": 0.156, "gel.relaxation_s": 0.326, "gel.thickness_mm": 1.7, "gel.crown_mm": 0.03558,
        "gel.shear_modulus_n_per_mm2": 0.155, "gel.poisson_ratio": 0.479, "grasp.finger_stiffness_n_per_mm": 17.0,
    }  # fmt: skip
    part = tmp_path / "part.toml"
    part.write_text('[object]\nshape = "hexagon"\nsize_x_mm = 33.1\nsize_y_mm = 33.1\nmass_kg = 0.265\n')
    cell = QuasiStaticCell(load_scene(str(part), blocks__free=True).varied(changes))
    cell.regrasp(-5.65, -1.84)
    x_mm, y_mm, top_mm, yaw_rad = cell.pose
    for depth_mm in np.arange(0.5, 11.0, 0.5):
        state = cell.move_to(x_mm, y_mm, top_mm - depth_mm, np.degrees(yaw_rad))
        assert state.residual_n <= 1e-7


def test_a_probe_that_breaks_a_promise_is_never_called_solved() -> None:
    cell = QuasiStaticCell(load_scene("rectangle"))
    state = cell.look()
    with pytest.raises(ImpossibleStateError, match="residual"):
        _check(cell, dataclasses.replace(state, residual_n=2e-6))
    with pytest.raises(ImpossibleStateError, match="non-finite"):
        _check(cell, dataclasses.replace(state, gel=state.gel * np.nan))


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_ten_thousand_hard_probes_end_solved_lost_or_refused_by_name() -> None:
    tally = Tally()
    for part in run(10_000, 12, "bristle", 1):
        tally.add(part)
    assert tally.ended.total() == 10_000


def test_what_the_grip_cannot_carry_is_lost_at_once() -> None:
    played = run_probe(load_scene("rectangle", gel__friction=0.0, effects__gravity="on"), 8.0, 0.0)
    assert played.outcome == "grasp_lost"


@pytest.mark.parametrize("name", ["rectangle", "circle", "ellipse"])
def test_the_convex_and_the_coupled_solver_find_one_equilibrium(name: str) -> None:
    ends = []
    for direct in (True, False):
        cell = QuasiStaticCell(load_scene(name, **UPRIGHT))
        cell.direct = direct
        cell.regrasp(8.0, 5.0)
        ends.append(cell.move_to(cell.pose[0], 0.0, cell.pose[2] - 6.2, 5.0))
    np.testing.assert_allclose(ends[0].wrench_n_nmm, ends[1].wrench_n_nmm, atol=0.03)
    np.testing.assert_allclose(ends[0].in_hand, ends[1].in_hand, atol=2e-4)


def test_drift_in_the_hand_is_remembered_after_the_load_is_gone() -> None:
    cell = QuasiStaticCell(load_scene("rectangle", **UPRIGHT))
    cell.regrasp(9.0, 0.0)
    x, y, z, yaw = cell.pose
    cell.move_to(x, y, z - 7.5, float(np.degrees(yaw)))
    back = cell.move_to(x, y, z, float(np.degrees(yaw)))
    assert not back.in_contact
    assert np.abs(back.wrench_n_nmm).max() < 1e-3
    assert np.degrees(abs(back.in_hand[4])) > 0.3


def test_without_friction_a_load_pushes_the_object_out_of_the_hand_or_up() -> None:
    played = run_probe(load_scene("rectangle", gel__friction=0.05, effects__gravity="off"), 8.0, 0.0)
    assert played.wrench[:, 2].max() < 2.0 * 0.05 * 20.0 * 1.1


def test_free_blocks_move_only_when_pushed_hard_enough() -> None:
    light = QuasiStaticCell(load_scene("circle", blocks__free=True, blocks__table_friction=0.02, **UPRIGHT))
    heavy = QuasiStaticCell(load_scene("circle", blocks__free=True, blocks__mass_kg=20.0, **UPRIGHT))
    for cell, moved in ((light, True), (heavy, False)):
        cell.regrasp(6.0, 0.0)
        cell.move_to(6.0, 0.0, cell.pose[2] - 7.0, 0.0)
        assert (np.abs(cell.look().block_motion[:, 0]).max() > 0.05) == moved


def test_a_cell_probed_again_starts_with_its_blocks_in_place() -> None:
    scene = load_scene("circle", blocks__free=True, blocks__table_friction=0.02, blocks__mass_kg=0.2, **UPRIGHT)
    cell = QuasiStaticCell(scene)
    first = run_probe(cell, 7.0, 0.0)
    assert np.abs(first.block_motion[:, 0]).max() > 0.05
    again = run_probe(cell, 7.0, 0.0)
    np.testing.assert_array_equal(again.gel, first.gel)
    np.testing.assert_array_equal(again.block_motion, first.block_motion)


@pytest.mark.parametrize("tier", ["bristle", "layer"])
def test_a_probe_says_of_every_marker_whether_it_slips(tier: str) -> None:
    played = run_probe(load_scene("rectangle", gel__tier=tier, **UPRIGHT), 9.0, 0.0)
    share = played.slipping.mean(axis=(2, 3))
    assert played.slipping.shape == played.gel.shape[:-1]
    assert not played.slipping[: played.onset_frame].any()
    assert share[played.true_slip_frame].max() >= 0.25
    assert share[played.true_slip_frame - 1].max() < 0.25
    pressed = played.gel[played.true_slip_frame, ..., 2] > 0
    assert not np.any(played.slipping[played.true_slip_frame] & ~pressed)


def fingerprint(case: tuple[str, str]) -> str:
    """Hash of one probe's bits; case: scene and tier."""
    name, tier = case
    played = run_probe(load_scene(name, gel__tier=tier), 7.0, -4.0, seed=3)
    return hashlib.sha256(played.gel.tobytes() + played.wrench.tobytes() + played.in_hand.tobytes()).hexdigest()


@pytest.mark.slow
def test_one_process_and_two_get_the_same_bits() -> None:
    cases = [(name, tier) for name in ("hexagon", "can") for tier in ("bristle", "layer")]
    here = [fingerprint(case) for case in cases]
    with get_context("spawn").Pool(2) as pool:
        assert pool.map(fingerprint, cases, chunksize=1) == here
    assert len(set(here)) == len(cases)
