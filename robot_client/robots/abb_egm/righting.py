"""A tool that leans a little about an axis that no target knows is righted by the first moves, and never at once."""

import math
from dataclasses import dataclass

from robot_client.insertion.geometry import (
    IDENTITY,
    CellFrame,
    Pose,
    Quaternion,
    WorkPose,
    conjugate,
    multiply,
    normalised,
)
from robot_client.insertion.motion import CYCLE_S, MISSED_CYCLES

RIGHTING_DEG_S = 5.0
_UPRIGHT_DEG = 1e-6


@dataclass(slots=True)
class Righting:
    """What the controller is sent for a target: ``lean`` is the part of the tool's rotation that the target lacks."""

    frame: CellFrame
    lean: Quaternion = IDENTITY

    @classmethod
    def of(cls, frame: CellFrame, measured: Pose, start: WorkPose) -> "Righting":
        """Of a tool at ``measured``, where guidance begins with the target ``start``."""
        upright = frame.to_controller(start)
        return cls(frame, _less(multiply(conjugate(upright.quaternion), normalised(measured.quaternion)), 0.0))

    def go_on(self, elapsed_s: float) -> None:
        """The target has moved for that long; after a gap the lean goes back by no more than the target went on."""
        self.lean = _less(self.lean, RIGHTING_DEG_S * min(elapsed_s, MISSED_CYCLES * CYCLE_S))

    def pose(self, target: WorkPose) -> Pose:
        """The controller's pose for a target; raises ValueError if it is not finite."""
        upright = self.frame.to_controller(target)
        if self.lean == IDENTITY:
            return upright
        leaning = normalised(multiply(upright.quaternion, self.lean))
        return Pose(upright.x_mm, upright.y_mm, upright.z_mm, *leaning)


def _less(rotation: Quaternion, by_deg: float) -> Quaternion:
    """A rotation, the short way, that is smaller by this angle."""
    w, x, y, z = rotation
    sine = math.hypot(x, y, z)
    half = math.atan2(sine, abs(w)) - math.radians(by_deg) / 2.0
    if half <= math.radians(_UPRIGHT_DEG) / 2.0:
        return IDENTITY
    scale = math.copysign(math.sin(half) / sine, w)
    return (math.cos(half), x * scale, y * scale, z * scale)
