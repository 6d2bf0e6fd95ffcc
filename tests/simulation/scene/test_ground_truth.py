"""Inserted means: all of the bottom face deep enough, where it fits, upright, in the grasp, no block pushed away."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulation.physics.kernels.linear import rotation_into
from simulation.physics.quasistatic import QuasiStaticCell
from simulation.scene.ground_truth import OVERLAP_MM, Pose, moved_mm, reasons_against
from simulation.scene.scene import Blocks
from simulation.scene.worlds import load_scene

BLOCKS = Blocks(gap_mm=56.0)
FOOT = np.array([[25.5, 50.0], [-25.5, 50.0], [-25.5, -50.0], [25.5, -50.0]])
STILL = np.zeros((2, 4))


def pose(x_mm=0.0, z_mm=-20.0, tilt_deg=0.0, yaw_deg=0.0):
    turn = np.empty((3, 3))
    rotation_into(turn, 0.0, np.radians(tilt_deg), 0.0)
    about_z = np.empty((3, 3))
    rotation_into(about_z, 0.0, 0.0, np.radians(yaw_deg))
    return Pose(about_z @ turn, np.array([x_mm, 0.0, z_mm]), FOOT)


def against(at, motion=STILL, *, lost=False):
    return reasons_against(at, motion, BLOCKS, grasp_lost=lost)


def test_an_upright_object_in_its_gap_is_inserted():
    assert against(pose()) == []
    assert against(pose(x_mm=2.4)) == []


@pytest.mark.parametrize(
    ("at", "motion", "lost", "word"),
    [
        (pose(24.0, -30.0, 42.0), np.array([[5.9, 0, 0, 0], [0, 0, 0, 0]]), False, "tilted"),  # jammed: findings
        (pose(tilt_deg=2.5), STILL, False, "tilted"),
        (pose(z_mm=-14.0), STILL, False, "deep"),  # pushed up in the hand
        (pose(), STILL, True, "grasp"),  # dropped in
        (pose(), np.array([[0.0, 0.0, 0.0, 0.0], [0.0, -1.2, 0.0, 0.0]]), False, "block"),
        (pose(), np.array([[0.0, 0.0, -0.8, 0.0], [0.0, 0.0, 0.0, 0.0]]), False, "block"),  # turned about its middle
        (pose(x_mm=4.0), STILL, False, "gap"),
        (pose(yaw_deg=8.0), STILL, False, "gap"),
        (pose(z_mm=np.nan), STILL, False, "deep"),
        (pose(), np.full((2, 4), np.nan), False, "block"),
    ],
)
def test_what_only_looks_inserted_is_not_and_says_why(at, motion, lost, word):
    assert any(word in reason for reason in against(at, motion, lost=lost))


@given(
    x=st.floats(-30, 30), z=st.floats(-40, 5), tilt=st.floats(-45, 45), yaw=st.floats(-30, 30),
    moved=st.floats(0, 8), lost=st.booleans(),
)  # fmt: skip
def test_whatever_counts_as_inserted_lies_whole_in_its_gap(x, z, tilt, yaw, moved, lost):
    at = pose(x, z, tilt, yaw)
    motion = np.array([[moved, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]])
    if against(at, motion, lost=lost):
        return
    assert not lost
    assert moved < 1.0
    assert at.outline[:, 2].max() <= -15.0
    assert np.abs(at.outline[:, 0]).max() <= 28.0 + OVERLAP_MM


@given(st.tuples(*[st.floats(-2, 2)] * 2), st.floats(-3, 3), st.integers(0, 1))
def test_a_block_has_moved_as_far_as_the_furthest_end_of_its_edge(shift_mm, yaw_deg, block):
    about_z = np.empty((3, 3))
    rotation_into(about_z, 0.0, 0.0, np.radians(yaw_deg))
    ends = np.array([[0.0, -0.5 * BLOCKS.size_y_mm, 0.0], [0.0, 0.5 * BLOCKS.size_y_mm, 0.0]])
    furthest = np.linalg.norm(ends @ about_z.T + [*shift_mm, 0.0] - ends, axis=1).max()
    motion = np.zeros((2, 4))
    motion[block] = [*shift_mm, yaw_deg, 0.0]
    assert moved_mm(motion, BLOCKS) == pytest.approx(furthest)


def test_a_scene_may_ask_for_more_depth():
    deep = Blocks(gap_mm=56.0, insertion_depth_mm=30.0)
    assert reasons_against(pose(), STILL, deep, grasp_lost=False)
    assert reasons_against(pose(z_mm=-31.0), STILL, deep, grasp_lost=False) == []


def test_a_box_forced_down_beside_its_gap_is_not_inserted():
    cell = QuasiStaticCell(load_scene("rectangle", blocks__free=True))
    cell.regrasp(9.0, 4.0)
    x, y, z, yaw = cell.pose
    for depth in np.arange(5.0, 20.0, 0.5):
        state = cell.move_to(x, y, z - depth, float(np.degrees(yaw)))
        assert not state.inserted
        if state.grasp_lost:
            break
