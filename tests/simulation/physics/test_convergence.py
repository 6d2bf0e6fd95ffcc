"""Guarantees of the numerics: order under load step and grid, dissipation, load-step error, drift of a held load."""

import numpy as np
import pytest

from simulation.data.probe import CellState, QuasiStaticCell
from simulation.scene.worlds import load_scene, object_names
from tests.simulation.scenes import UPRIGHT

TIERS = ("bristle", "layer")


def pressed(name: str, tier: str = "bristle", **changes: object) -> tuple[QuasiStaticCell, CellState]:
    """A poke 1.2 mm past touchdown: partly slipping, on one block."""
    cell = QuasiStaticCell(load_scene(name, gel__tier=tier, **UPRIGHT, **changes))
    cell.regrasp(8.0, 5.0)
    return cell, cell.move_to(cell.pose[0], 0.0, cell.pose[2] - 6.2, 5.0)


def apart(one: CellState, other: CellState) -> tuple[float, float]:
    """Distance in um and angle in deg between two poses in the hand."""
    shift = one.in_hand - other.in_hand
    return 1e3 * float(np.linalg.norm(shift[:3])), float(np.degrees(np.linalg.norm(shift[3:])))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "tier"), [("rectangle", "bristle"), ("rectangle", "layer"), ("circle", "layer")])
def test_what_slides_errs_by_the_first_order_of_the_load_step(name: str, tier: str) -> None:
    steps = (0.34, 0.17, 0.085)
    _, reference = pressed(name, tier, numerics__load_step_mm=0.01 if tier == "bristle" else 0.02)
    errors = [apart(pressed(name, tier, numerics__load_step_mm=step)[1], reference)[0] for step in steps]
    order = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert 0.8 < order < 1.4


def test_where_no_bristle_slips_the_load_step_changes_nothing() -> None:
    """The tips keep to the object's material, so that the way there is forgotten; the edge slides straight."""

    def stuck(step_mm: float) -> CellState:
        cell = QuasiStaticCell(
            load_scene("rectangle", numerics__load_step_mm=step_mm, effects__gravity="off", **UPRIGHT)
        )
        cell.regrasp(8.0, 0.0)
        return cell.move_to(cell.pose[0], 0.0, cell.pose[2] - 6.0, 0.0)

    micrometres, degrees = apart(stuck(1.0), stuck(0.02))
    assert micrometres < 0.001
    assert degrees < 1e-5


@pytest.mark.parametrize("name", ["rectangle", "circle"])
def test_the_error_falls_faster_than_the_nodes_pitch(name: str) -> None:
    def on(rows: int, columns: int) -> CellState:
        return pressed(name, gel__node_rows=rows, gel__node_columns=columns)[1]

    reference = on(80, 84)
    errors = [apart(on(rows, columns), reference)[0] for rows, columns in ((10, 11), (20, 21), (40, 42))]
    assert np.log2(errors[0] / errors[2]) / 2.0 > 1.5
    assert errors[0] > errors[1] > errors[2]


@pytest.mark.slow
@pytest.mark.parametrize("name", object_names())
def test_the_default_load_step_errs_by_less_than_the_limits(name: str) -> None:
    _, reference = pressed(name, numerics__load_step_mm=0.01)
    micrometres, degrees = apart(pressed(name)[1], reference)
    assert micrometres < 0.5
    assert degrees < 0.001


@pytest.mark.parametrize("tier", TIERS)
@pytest.mark.parametrize("name", ["rectangle", "mustard"])
def test_a_held_load_does_not_drift_in_a_second(name: str, tier: str) -> None:
    cell, first = pressed(name, tier)
    for _ in range(30):  # a second of frames, each solved anew
        cell._advance(cell.pose)
    last = cell.look()
    np.testing.assert_allclose(last.wrench_n_nmm[:3], first.wrench_n_nmm[:3], atol=1e-3 * first.wrench_n_nmm[2])
    assert apart(last, first)[0] < 1.0


def slides(cell: QuasiStaticCell, before: np.ndarray) -> np.ndarray:
    """Work of friction on every node in the last load step, N mm: traction times how far the object slid on it."""
    nodes, trial = cell.nodes, cell.trials[0]
    y = 0.5 * nodes["side"] * float(cell.state["opening"])
    start = np.stack([nodes["x"] + before[:, 0], y, nodes["z"] + before[:, 1]], axis=1)  # the bristles' tips
    moved = start @ trial["step_turn"].T + trial["step"] - start
    slid = [before[:, k] + moved[:, axis] - nodes[name] for k, (axis, name) in enumerate(((0, "sx"), (2, "sz")))]
    stiffness = float(cell.constants["kt"][0] * cell.constants["area"][0])
    return stiffness * (nodes["sx"] * slid[0] + nodes["sz"] * slid[1])


@pytest.mark.parametrize("name", ["rectangle", "circle", "hexagon"])
def test_friction_never_gives_work_back(name: str) -> None:
    cell = QuasiStaticCell(load_scene(name))
    cell.regrasp(9.0, 5.0)
    x, y, z, yaw = cell.pose
    total = 0.0
    for depth in (*np.arange(4.9, 6.6, 0.1), *np.arange(6.5, 4.9, -0.1)):
        before = np.stack([cell.nodes["sx"], cell.nodes["sz"]], axis=1)
        cell._advance(np.array([x, y, z - depth, yaw]))
        work = slides(cell, before)
        assert work.min() > -1e-9
        total += work.sum()
    assert total > 0.1


def cycle_work(step_mm: float, **changes: object) -> float:
    """Work of the hand over a poke down and up again, N mm (trapezoid rule)."""
    cell = QuasiStaticCell(load_scene("rectangle", effects__gravity="off", **UPRIGHT, **changes))
    cell.regrasp(9.0, 0.0)
    x, _, z, _ = cell.pose
    depths = 4.99 + np.concatenate([np.arange(0.0, 1.2, step_mm), np.arange(1.2, -0.01, -step_mm)])
    force = [float(cell.move_to(x, 0.0, z - depth, 0.0).wrench_n_nmm[2]) for depth in depths]
    return float(np.sum(0.5 * (np.array(force[1:]) + force[:-1]) * np.diff(depths)))


def test_a_poke_down_and_up_costs_work_where_things_slide_and_none_where_they_stick() -> None:
    sliding = cycle_work(0.05)
    assert sliding > 0.1
    assert abs(cycle_work(0.05, gel__friction=2.0, blocks__friction=0.0)) < 0.02 * sliding
