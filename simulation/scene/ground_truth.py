"""Whether an object is inserted: the single definition used by every table, report and live cell.

An object counts as inserted when all of its bottom face is deep enough below the block tops, and it lies in its gap as
an object of its size can, stands upright, is still in the grasp, and has not made room by pushing a block. A lowest
corner that is deep enough proves nothing: a box jammed at 42 degrees has one.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from simulation.scene.parts import Blocks

Array = NDArray[np.float64]

TILT_DEG = 2.0
BLOCK_MM = 1.0  # largest allowed displacement of a block, anywhere along its edge at the gap
OVERLAP_MM = 0.15  # largest allowed penetration of a wall: 120 N on the scenes' 1000 N/mm, rounded up


class Pose(NamedTuple):
    """Pose of the held object in the work-object frame.

    turn [3, 3]: its axes. bottom [3], mm: the centre of its bottom face. footprint [v, 2], mm: that face's outline in
    the object's frame.
    """

    turn: Array
    bottom: Array
    footprint: Array

    @property
    def outline(self) -> Array:
        """The bottom face's outline [v, 3], mm, in the work-object frame."""
        return np.asarray(self.footprint @ self.turn[:, :2].T + self.bottom)


def moved_mm(block_motion: Array, blocks: Blocks) -> float:
    """How far the blocks have moved, mm: the furthest end of their top edges at the gap.

    block_motion [2, 4]: dx, dy mm of the edge's middle, yaw, tilt deg. A block that tips takes its edge along; one that
    yaws moves its ends further than its middle.
    """
    dx, dy, yaw = block_motion[:, :1], block_motion[:, 1:2], np.radians(block_motion[:, 2:3])
    along = np.array([-0.5, 0.5]) * blocks.size_y_mm
    return float(np.hypot(dx - np.sin(yaw) * along, dy + (np.cos(yaw) - 1.0) * along).max())


def reasons_against(pose: Pose, block_motion: Array, blocks: Blocks, *, grasp_lost: bool) -> list[str]:
    """Why the object does not count as inserted, one sentence each; empty if it is inserted.

    block_motion [2, 4]: dx, dy mm, yaw, tilt deg of each block. blocks: as in the scene. Non-finite numbers are
    reasons, too.
    """
    outline, depth_mm, half_gap_mm = pose.outline, blocks.insertion_depth_mm, 0.5 * blocks.gap_mm
    highest, across = float(outline[:, 2].max()), float(np.abs(outline[:, 0]).max())
    tilt_deg = float(np.degrees(np.arccos(np.clip(pose.turn[2, 2], -1.0, 1.0))))
    pushed_mm = moved_mm(block_motion, blocks)
    checks = (
        (highest <= -depth_mm, f"its bottom is {-highest:.1f} mm deep at its highest point, {depth_mm:g} are needed"),
        (
            across <= half_gap_mm + OVERLAP_MM,
            f"it reaches {across:.1f} mm from the gap's centre, {half_gap_mm:g} fit",
        ),
        (tilt_deg < TILT_DEG, f"it is tilted by {tilt_deg:.1f} deg, below {TILT_DEG:g} counts"),
        (pushed_mm < BLOCK_MM, f"a block was moved by {pushed_mm:.1f} mm, below {BLOCK_MM:g} counts"),
        (not grasp_lost, "it is not in the grasp any more"),
    )
    return [sentence for holds, sentence in checks if not holds]
