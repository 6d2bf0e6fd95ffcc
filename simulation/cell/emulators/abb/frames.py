"""The poses of work object and tool: conversions between the cell's frame, the robot's base and its joints."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robot_client.insertion.geometry import Vector
from simulation.cell.emulators.abb.irb1600 import ReachError, inverse
from simulation.cell.emulators.abb.motion import Pose


@dataclass(frozen=True, slots=True)
class CellFrames:
    """The work object in the base frame, along its axes, and the length from the flange to the TCP."""

    work_object_mm: Vector = (800.0, 0.0, 300.0)
    tool_length_mm: float = 260.0

    def in_base(self, pose: Pose) -> Pose:
        """A work-object pose in the frame of the robot's base."""
        x, y, z = (at + origin for at, origin in zip(pose.position_mm, self.work_object_mm, strict=True))
        return Pose((x, y, z), pose.quaternion)

    def joints_deg(self, pose: Pose) -> tuple[float, ...]:
        """Joint angles of a TCP pose in the work object; empty where the arm cannot reach it."""
        rotation: NDArray[np.float64] = Rotation.from_quat(pose.quaternion, scalar_first=True).as_matrix()
        flange = np.array(self.in_base(pose).position_mm) - self.tool_length_mm * rotation[:, 2]
        try:
            return inverse(flange, rotation)
        except ReachError:
            return ()
