"""The foreign cell keeps the laws of mechanics."""

import itertools
import math

import numpy as np
import pytest

from simulation.foreign import cell as foreign
from simulation.foreign.cell import TOLERANCE_N, ForeignCell
from simulation.foreign.elements import Pad
from simulation.foreign.pads import OPEN, SLIP, STICK
from simulation.scene.state import PhysicsError
from simulation.scene.worlds import load_scene
from tests.simulation.scenes import UPRIGHT

COARSE = Pad(22.05, 21.0, 2.5, 0.48, columns=4, rows=4, layers=1)


def held(name="rectangle", x_mm=8.0, theta_deg=0.0, *, pad=COARSE, **changes):
    """A cell with an object in the hand."""
    cell = ForeignCell(load_scene(name, **(UPRIGHT | changes)), 0, pad)
    cell.regrasp(x_mm, theta_deg)
    return cell


def lowered(cell, depth_mm):
    """The state so deep below first touch."""
    x, y, z, yaw = cell.pose
    return cell.move_to(x, y, z - 5.0 - depth_mm, math.degrees(yaw))


@pytest.fixture(scope="module")
def pressed():
    """A yawed rectangle 1 mm down on one edge."""
    cell = held(theta_deg=5.0)
    return cell, lowered(cell, 1.0)


def test_what_the_pads_do_balances_blocks_and_weight(pressed):
    cell, state = pressed
    forces, points = cell.pads.forces(cell.grip), cell.grip.points
    assert forces.sum(axis=0) == pytest.approx(state.wrench_n_nmm[:3], abs=1e-6)
    assert np.cross(points, forces).sum(axis=0) == pytest.approx(state.wrench_n_nmm[3:], abs=1e-5)
    assert state.wrench_n_nmm[2] > 3.0
    assert state.residual_n <= TOLERANCE_N


def lawful(cell):
    """Fail where a node pulls, penetrates the surface next to it, or leaves its friction cone there."""
    grip, planes = cell.grip, cell.pads.planes(cell.held, cell.grip.on)
    terms = cell.pads.evaluate(grip, planes, grip.on, None)
    drag = np.linalg.norm(terms.drag, axis=1)
    closed = grip.status != OPEN
    assert terms.pressing[closed].min() >= -1e-6
    assert np.abs(terms.forces[~closed]).max(initial=0.0) <= 1e-6
    assert planes.gap(grip.on).min() >= -1e-9
    assert (drag - cell.pads.friction * terms.pressing)[closed].max() <= 1e-6


def test_no_node_pulls_penetrates_or_leaves_the_friction_cone(pressed):
    cell, _ = pressed
    lawful(cell)
    assert (cell.grip.status == SLIP).any()
    assert (cell.grip.status == STICK).any()


@pytest.mark.parametrize("theta_deg", [0.0, 7.0])
def test_a_gel_that_slides_far_along_a_curve_is_at_rest_where_it_comes_to_lie(theta_deg):
    cell = held("ellipse", 3.0, theta_deg, gel__friction=0.2, numerics__load_step_mm=1.0)
    lowered(cell, 0.6)
    lawful(cell)


def test_the_grip_is_what_the_scene_says():
    cell = held(x_mm=0.0)
    across = cell.pads.forces(cell.grip)[:, 1].reshape(2, -1).sum(axis=1)
    assert across == pytest.approx([20.0, -20.0], rel=2e-3)


def test_in_the_air_the_pads_carry_the_weight():
    cell = held(x_mm=0.0, object__mass_kg=0.3)
    assert cell.look().wrench_n_nmm[2] == pytest.approx(-0.3 * 9.81)


def test_a_weight_beyond_friction_is_lost():
    assert held(x_mm=0.0, object__mass_kg=2.0, gel__friction=0.2).look().grasp_lost


def test_an_object_that_slid_out_of_the_grasp_pushes_on_the_hand_no_more():
    state = lowered(held(x_mm=0.0, theta_deg=20.0, gel__friction=0.2, numerics__load_step_mm=1.0), 16.0)
    assert state.grasp_lost
    assert np.abs(state.wrench_n_nmm).max() == 0.0


def test_the_moment_over_the_force_is_the_edges_lever():
    """A vertical push at the block's edge, without friction there: moment about y is force times G / 2 - |x|."""
    cell = held(x_mm=8.0, effects__edge_friction="off", object__mass_kg=1e-3)
    state = lowered(cell, 0.6)
    along, up, moment = state.wrench_n_nmm[[0, 2, 4]]
    assert up > 1.0
    edge_mm = 0.5 * cell.scene.blocks.gap_mm - cell.pose[0]
    assert (-cell.pose[2] * along - moment) / up == pytest.approx(edge_mm, rel=0.005)


def test_left_and_right_mirror_each_other():
    one, other = held(x_mm=8.0, theta_deg=4.0), held(x_mm=-8.0, theta_deg=-4.0)
    a, b = lowered(one, 0.8), lowered(other, 0.8)
    assert a.wrench_n_nmm == pytest.approx(
        b.wrench_n_nmm * [-1, 1, 1, 1, -1, -1], abs=2e-4 * np.abs(a.wrench_n_nmm).max()
    )


@pytest.mark.slow
def test_slip_begins_at_the_rim_and_grows():
    """As in Cattaneo's and Mindlin's contact, though a pad's pressure is flatter than theirs."""
    cell = held(x_mm=8.0, gel__crown_mm=0.4)
    shares, radii = [], []
    for depth in (0.15, 0.6, 1.2):
        state = lowered(cell, depth)
        shares.append(float(state.slipping_share.mean()))
        nodes = np.hypot(cell.pads.rest[:, 0], cell.pads.rest[:, 2])
        radii.append((nodes[cell.grip.status == SLIP].mean(), nodes[cell.grip.status == STICK].mean()))
    assert shares == sorted(shares)
    assert radii[0][0] > radii[0][1]


def test_without_slip_the_way_there_does_not_matter():
    ends = []
    for step in (0.05, 0.5):
        cell = held(x_mm=8.0, gel__friction=2.0, numerics__load_step_mm=step)
        ends.append(lowered(cell, 0.5).wrench_n_nmm)
    assert ends[0] == pytest.approx(ends[1], rel=0.05, abs=0.5)


def test_free_blocks_stand_still_under_their_own_weight_and_move_when_shoved():
    cell = held(x_mm=8.0, blocks__free=True)
    assert np.abs(lowered(cell, 0.5).block_motion).max() < 0.05
    shoved = held(x_mm=8.0, blocks__free=True, blocks__table_friction=0.02)
    assert np.abs(lowered(shoved, 2.0).block_motion).max() > 0.05


@pytest.mark.parametrize("name", ["circle", "hexagon", "ellipse"])
def test_every_held_face_comes_to_rest(name):
    state = lowered(held(name, x_mm=9.0, theta_deg=6.0), 0.5)
    assert state.in_contact
    assert np.isfinite(state.gel).all()
    assert state.residual_n <= TOLERANCE_N


@pytest.mark.parametrize("seed", [3, 5, 6, 8])
def test_an_object_narrower_than_the_pads_comes_to_rest_askew_between_them(seed):
    cell = ForeignCell(load_scene("rectangle", object__size_x_mm=12.0), seed, COARSE)
    assert cell.regrasp(8.0, 5.0).residual_n <= TOLERANCE_N


def test_a_centred_object_is_inserted_by_the_common_ground_truth():
    cell = held(x_mm=0.3)
    assert lowered(cell, 20.0).inserted


def test_the_markers_follow_the_object_down():
    cell = held(x_mm=8.0)
    before, after = cell.look().gel, lowered(cell, 0.8).gel
    assert before.shape == (2, cell.scene.sensor.marker_rows, cell.scene.sensor.marker_columns, 4)
    up = -(after - before)[..., 1].mean(axis=(1, 2))
    assert (up > 0.02).all()


def test_a_grip_that_squeezes_the_gel_through_is_refused_by_name():
    with pytest.raises(PhysicsError) as refused:
        held(grasp__force_n=120.0, gel__shear_modulus_n_per_mm2=0.005)
    assert refused.value.reason in {"gel squeezed through", "pads unsettled"}


def test_numbers_that_are_none_are_refused():
    with pytest.raises(ValueError, match="finite"):
        held().move_to(0.0, 0.0, math.nan, 0.0)


def test_open_nodes_feel_nothing_and_the_rest_is_as_stiff_as_the_whole():
    cell = held()
    pads, opened = cell.pads, np.zeros(cell.pads.count, np.bool_)
    opened[:7] = True
    part = pads.let_go(0, opened)
    moved = np.zeros((pads.count, 3))
    moved[part.closed] = np.random.default_rng(0).normal(size=(len(part.closed), 3))
    moved[part.open_] = (part.follow @ moved[part.closed].ravel()).reshape(-1, 3)
    forces = (pads.stiffness[0] @ moved.ravel()).reshape(-1, 3)
    assert np.abs(forces[part.open_]).max() < 1e-9
    assert forces[part.closed].ravel() == pytest.approx(part.stiffness @ moved[part.closed].ravel(), abs=1e-9)


def test_rounds_settle_what_goes_round_in_circles():
    """A slanted object between grippy pads: limits that follow the pressures lead back and forth, held ones do not."""
    cell = ForeignCell(load_scene("white_box", gel__friction=2.0), 6, COARSE)
    assert cell.look().residual_n <= TOLERANCE_N


def test_a_grasp_that_seldom_comes_to_rest_ends_before_it_costs_an_hour(monkeypatch):
    """Every other load step fails once and is halved: the motion completes, at several times its cost."""
    monkeypatch.setattr(foreign, "FAILED_N", 3)
    cell, solve, calls = held(), ForeignCell._rests, itertools.count()
    monkeypatch.setattr(ForeignCell, "_rests", lambda self, *step: next(calls) % 3 != 0 and solve(self, *step))
    with pytest.raises(PhysicsError, match="no equilibrium"):
        lowered(cell, 2.0)


STIFF_AND_SLIPPERY = {
    "object__size_x_mm": 110.0, "object__size_y_mm": 110.0, "object__mass_kg": 0.356,
    "gel__poisson_ratio": 0.457849, "gel__crown_mm": 0.079925, "gel__wear": 0.052874, "gel__margin_mm": [1.222, 0.605],
    "gel__friction": 0.5035, "gel__thickness_mm": 1.834, "gel__shear_modulus_n_per_mm2": 0.145,
    "grasp__height_mm": 39.243308, "grasp__force_n": 15.39, "blocks__friction": 0.23444,
    "blocks__stiffness_n_per_mm": 2565.0, "blocks__mass_kg": 0.8458, "blocks__free": True, "blocks__gap_mm": 114.0,
}  # fmt: skip


@pytest.mark.slow
def test_a_hand_that_turns_back_leaves_a_stiff_edge():
    """Of the sealed test: the edge gives its 8 N away within 4 um of the way up, and no longer step found rest."""
    cell = ForeignCell(load_scene("hexagon", **STIFF_AND_SLIPPERY), 235987039957034)
    cell.regrasp(1.059766456402902, 5.91789177702516)
    x, y, yaw = 2.577501653717265, 1.3244280139746556, 4.843439691756368
    for z in (44.2433, 38.1566, 38.0784, 38.0373, 37.9591, 37.918, 37.8397, 37.7987, 37.7204, 37.6793, 37.6389):
        assert cell.move_to(x, y, z, yaw).residual_n <= TOLERANCE_N
    assert cell.bodies.touching
    assert cell.move_to(x, y, 44.0, yaw).residual_n <= TOLERANCE_N
    assert not cell.bodies.touching


def test_a_held_displacement_loses_the_relaxing_share_of_its_force():
    quick = {"gel__friction": 2.0, "effects__gravity": "off", "blocks__stiffness_n_per_mm": 5e4}
    cell = held(gel__relaxation_share=0.4, gel__relaxation_s=0.5, **quick)
    cell.pace_mm_s = 1e6
    at_once_n = lowered(cell, 0.3).wrench_n_nmm[2]
    shares = [cell.wait(0.5).wrench_n_nmm[2] / at_once_n for _ in range(4)]
    assert shares == pytest.approx([1.0 - 0.4 * (1.0 - math.exp(-n)) for n in (1, 2, 3, 4)], abs=5e-3)


def test_a_slow_press_is_softer_where_the_gel_relaxes_and_the_next_grasp_has_forgotten_it():
    def pressed_n(cell, pace_mm_s):
        cell.regrasp(8.0, 0.0)
        cell.pace_mm_s = pace_mm_s
        return lowered(cell, 0.5).wrench_n_nmm[2]

    relaxing, elastic = held(gel__relaxation_share=0.3, gel__relaxation_s=0.2), held()
    quick_n, slow_n, again_n = (pressed_n(relaxing, pace_mm_s) for pace_mm_s in (1e6, 1.0, 1e6))
    assert slow_n < 0.9 * quick_n
    assert again_n == pytest.approx(quick_n, rel=1e-6)
    assert quick_n == pytest.approx(pressed_n(elastic, 1.0), rel=1e-3)


def test_a_finger_and_its_gel_are_springs_in_series_of_which_the_camera_sees_the_gel():
    def pushed(cell):
        grip = cell.grip.copy()
        grip.place[0] += 0.1
        forces_n, seen_mm = (method(grip) - method(cell.grip) for method in (cell.pads.forces, cell.pads.displacement))
        return forces_n[:, 0].reshape(2, -1).sum(axis=1), seen_mm[:, 0]

    (rigid_n, rigid_mm), (bent_n, bent_mm) = (
        pushed(held(x_mm=0.0, grasp__finger_stiffness_n_per_mm=stiffness)) for stiffness in (0.0, 20.0)
    )
    assert rigid_mm == pytest.approx(0.1)
    assert 0.1 / bent_n == pytest.approx(0.1 / rigid_n + 1.0 / 20.0, rel=1e-6)
    assert bent_mm == pytest.approx(np.repeat(0.1 - bent_n / 20.0, len(bent_mm) // 2), rel=1e-6)
