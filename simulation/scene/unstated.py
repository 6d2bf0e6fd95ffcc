"""What the software does not know: errors of its calibration, and the mistakes of a first day.

*Reported* poses are those of the TCP in the terms of arm and client, in the work-object frame that they were taught.
*True* poses are those of the middle between the fingers (and with it the object), in the frame of the blocks.

At a commanded pose p the hand is at `Misplacement.true(p)`, computed in this order: a wrong sign inverts the motion
since the approach; ``tcp_offset_mm``, in the tool frame, turns with the tool; ``frame_yaw_deg`` turns the arm's work
object about the gap's centre; ``blocks_up_mm`` lifts the blocks towards the hand.
"""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field

from simulation.scene.parts import Listed, Part

Pose = tuple[float, float, float, float]
"""TCP x, y, z in mm and yaw in deg."""
Shift = Annotated[float, Field(ge=-20.0, le=20.0)]
Scale = Annotated[float, Field(ge=0.8, le=1.25)]
Roll = Annotated[float, Field(ge=-30.0, le=30.0)]


def _whole(given: object) -> object:
    """1.0 is 1 in TOML as well. True is not, though Python takes it for 1."""
    if isinstance(given, bool):
        return str(given)
    return int(given) if given in (1.0, -1.0) else given


Sign = Annotated[Literal[1, -1], BeforeValidator(_whole)]


class Unstated(Part):
    """The table `[world]` of a world file.

    ``tcp_offset_mm`` (x, y): true position of the middle between the fingers, in the arm's tool frame.
    ``frame_yaw_deg``: yaw error of the arm's work object; an object reported as straight has this yaw, and reported x
    and y are askew by it. ``camera_scale`` and ``camera_roll_deg`` (left, right): errors of the calibration of that
    finger's camera. Its rectified picture is too large by that factor, and turned clockwise as displayed, about its
    middle. ``stop_lag_s``: delay until an ordered stop takes effect. ``blocks_up_mm``: height of the block tops above
    the reported one. The gap and the grasp height given to the software contain the stated errors. ``swapped_fingers``:
    either camera's frames come under the other's name, together with its calibration. ``mirrored`` (left, right): that
    camera delivers its frames mirrored, left for right, since its calibration. ``x_sign``, ``yaw_sign``: -1 moves the
    arm opposite to the command in x or yaw, seen from the approach.
    """

    tcp_offset_mm: Annotated[tuple[Shift, Shift], Listed] = (0.0, 0.0)
    frame_yaw_deg: float = Field(default=0.0, ge=-30.0, le=30.0)
    camera_scale: Annotated[tuple[Scale, Scale], Listed] = (1.0, 1.0)
    camera_roll_deg: Annotated[tuple[Roll, Roll], Listed] = (0.0, 0.0)
    stop_lag_s: float = Field(default=0.03, ge=0.0, le=0.5)
    blocks_up_mm: float = Field(default=0.0, ge=-20.0, le=20.0)
    told_gap_error_mm: float = Field(default=0.0, ge=-20.0, le=20.0)
    told_height_error_mm: float = Field(default=0.0, ge=-50.0, le=50.0)
    swapped_fingers: bool = False
    mirrored: Annotated[tuple[bool, bool], Listed] = (False, False)
    x_sign: Sign = 1
    yaw_sign: Sign = 1

    @property
    def well_placed(self) -> bool:
        """Whether commanded and true poses are the same."""
        straight = self.tcp_offset_mm == (0.0, 0.0) and self.frame_yaw_deg == 0.0 and self.blocks_up_mm == 0.0
        return straight and self.x_sign == self.yaw_sign == 1

    @property
    def wired_right(self) -> bool:
        """Whether nothing is swapped, mirrored or reversed, as a commissioning makes sure."""
        return not (self.swapped_fingers or any(self.mirrored)) and self.x_sign == self.yaw_sign == 1

    def residual_px(self, index: int, centre_px: tuple[float, float]) -> NDArray[np.float64] | None:
        """Error of a camera's calibration, [3, 3] on rectified pixels about the picture's centre, or None."""
        if self.camera_scale[index] == 1.0 and self.camera_roll_deg[index] == 0.0:
            return None
        out = np.eye(3)
        out[:2, :2] = self.turned_and_scaled(index)
        out[:2, 2] = np.asarray(centre_px) - out[:2, :2] @ np.asarray(centre_px)
        return out

    def turned_and_scaled(self, index: int) -> NDArray[np.float64]:
        """The same for a displacement (u right, v down), [2, 2]."""
        roll, scale = math.radians(self.camera_roll_deg[index]), self.camera_scale[index]
        cos, sin = scale * math.cos(roll), scale * math.sin(roll)
        return np.array([[cos, -sin], [sin, cos]])


@dataclass(frozen=True, slots=True)
class Misplacement:
    """Commanded and true poses of one insertion; ``approach`` is the commanded pose to which its corrections refer."""

    unstated: Unstated
    approach: Pose

    def true(self, reported: Pose) -> Pose:
        """True pose of the hand when the arm reports ``reported``."""
        world = self.unstated
        if world.well_placed:
            return reported
        x, y, z, yaw = self._signed(reported)
        dx, dy = _turned(*world.tcp_offset_mm, yaw)
        x, y = _turned(x + dx, y + dy, world.frame_yaw_deg)
        return x, y, z - world.blocks_up_mm, yaw + world.frame_yaw_deg

    def reported(self, true: Pose) -> Pose:
        """Pose that the arm reports when the hand is at ``true``."""
        world = self.unstated
        if world.well_placed:
            return true
        x, y, z, yaw = true
        yaw -= world.frame_yaw_deg
        x, y = _turned(x, y, -world.frame_yaw_deg)
        dx, dy = _turned(*world.tcp_offset_mm, yaw)
        return self._signed((x - dx, y - dy, z + world.blocks_up_mm, yaw))

    def _signed(self, pose: Pose) -> Pose:
        """Apply the wrong signs; its own inverse."""
        x, y, z, yaw = pose
        x0, _, _, yaw0 = self.approach
        return x0 + self.unstated.x_sign * (x - x0), y, z, yaw0 + self.unstated.yaw_sign * (yaw - yaw0)


def _turned(x: float, y: float, deg: float) -> tuple[float, float]:
    cos, sin = math.cos(math.radians(deg)), math.sin(math.radians(deg))
    return cos * x - sin * y, sin * x + cos * y
