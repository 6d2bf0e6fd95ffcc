"""Where the work object and the tool are: between the cell's frame, the robot's base and its joints."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from simulation.cell.emulators.abb.irb1600 import ReachError, forward, inverse
from simulation.cell.emulators.abb.motion import Pose, Quaternion, Vector, multiply, normalised, rotated


def matrix_of(q: Quaternion) -> NDArray[np.float64]:
    """Rotation matrix [3, 3] of a unit quaternion."""
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_of(m: NDArray[np.float64]) -> Quaternion:
    """Unit quaternion of a rotation matrix [3, 3]; exact at half turns (largest component first)."""
    squares = [
        1 + m[0, 0] + m[1, 1] + m[2, 2],
        1 + m[0, 0] - m[1, 1] - m[2, 2],
        1 - m[0, 0] + m[1, 1] - m[2, 2],
        1 - m[0, 0] - m[1, 1] + m[2, 2],
    ]
    k = int(np.argmax(squares))
    wx, wy, wz = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    xy, xz, yz = m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1]
    rows = (
        (squares[0], wx, wy, wz),
        (wx, squares[1], xy, xz),
        (wy, xy, squares[2], yz),
        (wz, xz, yz, squares[3]),
    )
    w, x, y, z = (float(c) for c in rows[k])
    return normalised((w, x, y, z))


@dataclass(frozen=True, slots=True)
class CellFrames:
    """Work object in the base (position, yaw) and length of gripper and fingers from the flange to the TCP."""

    work_object_mm: Vector = (800.0, 0.0, 300.0)
    work_object_yaw_deg: float = 0.0
    tool_length_mm: float = 260.0

    @property
    def _turn(self) -> Quaternion:
        return rotated((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, math.radians(self.work_object_yaw_deg)))

    def in_base(self, pose: Pose) -> Pose:
        """A work-object pose seen from the robot's base."""
        position = matrix_of(self._turn) @ np.array(pose.position_mm) + np.array(self.work_object_mm)
        x, y, z = (float(c) for c in position)
        return Pose((x, y, z), multiply(self._turn, pose.quaternion))

    def joints_deg(self, pose: Pose) -> tuple[float, ...]:
        """Joint angles of a TCP pose in the work object; empty where the arm cannot reach it."""
        base = self.in_base(pose)
        rotation = matrix_of(base.quaternion)
        flange = np.array(base.position_mm) - self.tool_length_mm * rotation[:, 2]
        try:
            return inverse(flange, rotation)
        except ReachError:
            return ()

    def pose_of_joints(self, joints_deg: tuple[float, ...]) -> Pose:
        """TCP pose in the work object for six joint angles in degrees."""
        flange, rotation = forward(joints_deg)
        tcp = flange + self.tool_length_mm * rotation[:, 2]
        turn = matrix_of(self._turn).T
        x, y, z = (float(c) for c in turn @ (tcp - np.array(self.work_object_mm)))
        return Pose((x, y, z), quaternion_of(turn @ rotation))
