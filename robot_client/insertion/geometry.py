"""Poses in the work-object frame, and their conversion to and from the quaternions that robot controllers use.

Work-object frame: origin at the gap's centre at the height of the blocks' top faces, x across the gap, y along it,
z up; mm and deg. Quaternions are (w, x, y, z) of unit norm. Half-angle formulas hold at any angle.
"""

import math
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field, field_validator

from service.contract.frames import Contract

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

Reach = Annotated[float, Field(ge=-1e6, le=1e6)]
"""A kilometre, or a million degrees: larger values are errors, and their sums would overflow."""

IDENTITY: Quaternion = (1.0, 0.0, 0.0, 0.0)
TOOL_DOWN: Quaternion = (0.0, 1.0, 0.0, 0.0)
QUATERNION_TOLERANCE = 1e-2  # a real controller rounds; beyond this it is no rotation


@dataclass(frozen=True, slots=True)
class Pose:
    """Position in mm and unit quaternion (w, x, y, z) of the tool in the work object active on the controller."""

    x_mm: float
    y_mm: float
    z_mm: float
    qw: float = 1.0
    qx: float = 0.0
    qy: float = 0.0
    qz: float = 0.0

    @property
    def quaternion(self) -> Quaternion:
        """(w, x, y, z)."""
        return (self.qw, self.qx, self.qy, self.qz)

    def check(self, name: str = "pose") -> "Pose":
        """This pose if it is finite and its quaternion has unit norm; raises ValueError otherwise."""
        values = (self.x_mm, self.y_mm, self.z_mm, *self.quaternion)
        if not all(map(math.isfinite, values)):
            raise ValueError(f"{name} is {values}, expected finite numbers")
        norm = math.hypot(*self.quaternion)
        if abs(norm - 1.0) > QUATERNION_TOLERANCE:
            raise ValueError(f"{name} has a quaternion of norm {norm:.4f}, expected 1")
        return self


class WorkPose(Contract):
    """Pose of the TCP (midway between the fingertips) in the work-object frame.

    ``tilt_deg``: from the vertical, about the axis from the right finger to the left one (y at yaw 0).
    """

    x_mm: Reach
    y_mm: Reach
    z_mm: Reach
    yaw_deg: Reach
    tilt_deg: Reach = 0.0

    def at_height(self, z_mm: float) -> "WorkPose":
        """The same pose at another height: a move along the vertical."""
        return self._with(z_mm=z_mm)

    def corrected(self, dx_mm: float, dtheta_deg: float) -> "WorkPose":
        """This pose moved by a correction: new error = old error + correction."""
        return self._with(x_mm=self.x_mm + dx_mm, yaw_deg=self.yaw_deg + dtheta_deg)

    def tilted(self, tilt_deg: float) -> "WorkPose":
        """This pose with another tilt."""
        return self._with(tilt_deg=tilt_deg)

    def _with(self, **changes: float) -> "WorkPose":
        return WorkPose(**{**dict(self), **changes})  # a copy that is validated

    def distance_mm(self, other: "WorkPose") -> float:
        """Length of the straight line to ``other`` in mm."""
        return math.dist((self.x_mm, self.y_mm, self.z_mm), (other.x_mm, other.y_mm, other.z_mm))

    def turn_deg(self, other: "WorkPose") -> float:
        """The larger of yaw and tilt to ``other``, absolute, in deg."""
        return max(abs(other.yaw_deg - self.yaw_deg), abs(other.tilt_deg - self.tilt_deg))

    def towards(self, other: "WorkPose", share: float) -> "WorkPose":
        """The point at ``share`` (0..1) of the straight line to ``other``, yaw and tilt in the same share."""
        return WorkPose(
            x_mm=self.x_mm + (other.x_mm - self.x_mm) * share,
            y_mm=self.y_mm + (other.y_mm - self.y_mm) * share,
            z_mm=self.z_mm + (other.z_mm - self.z_mm) * share,
            yaw_deg=self.yaw_deg + (other.yaw_deg - self.yaw_deg) * share,
            tilt_deg=self.tilt_deg + (other.tilt_deg - self.tilt_deg) * share,
        )


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """Hamilton product: the rotation b followed by a; raises ValueError if it is not finite."""
    product = (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )
    if not all(map(math.isfinite, product)):
        raise ValueError(f"product of {a} and {b} is {product}, expected finite numbers")
    return product


def conjugate(q: Quaternion) -> Quaternion:
    return (q[0], -q[1], -q[2], -q[3])


def rotate(q: Quaternion, vector: Vector) -> Vector:
    """``vector`` turned by ``q``."""
    _, x, y, z = multiply(multiply(q, (0.0, *vector)), conjugate(q))
    return (x, y, z)


def turn_quaternion(yaw_deg: float, tilt_deg: float = 0.0) -> Quaternion:
    """Rotation by ``yaw_deg`` about +z and then by ``tilt_deg`` about the new y; raises ValueError if not finite."""
    if not (math.isfinite(yaw_deg) and math.isfinite(tilt_deg)):
        raise ValueError(f"yaw of {yaw_deg} deg and tilt of {tilt_deg} deg, expected finite numbers")
    half, lean = math.radians(yaw_deg) / 2.0, math.radians(tilt_deg) / 2.0
    yaw, tilt = (math.cos(half), math.sin(half)), (math.cos(lean), math.sin(lean))
    return (yaw[0] * tilt[0], -yaw[1] * tilt[1], yaw[0] * tilt[1], yaw[1] * tilt[0])


def normalised(q: Quaternion) -> Quaternion:
    """Unit quaternion along ``q``; raises ValueError if it has no direction."""
    norm = math.hypot(*q)
    if not (math.isfinite(norm) and norm > 1e-9):
        raise ValueError(f"{q} is no rotation, expected a quaternion w, x, y, z")
    return (q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm)


class CellFrame(Contract):
    r"""The work object in the frame of the controller's poses, and the tool at yaw 0; quaternions of any length.

    With the work object active on the controller (\WObj of EGMActPose) the frame is the identity.
    """

    origin_mm: Vector = (0.0, 0.0, 0.0)
    rotation: Quaternion = IDENTITY
    tool: Quaternion = TOOL_DOWN

    @field_validator("rotation", "tool")
    @classmethod
    def _unit(cls, quaternion: Quaternion) -> Quaternion:
        return normalised(quaternion)

    def to_controller(self, pose: WorkPose) -> Pose:
        """The controller's pose of the TCP; raises ValueError if it is not finite."""
        x, y, z = rotate(self.rotation, (pose.x_mm, pose.y_mm, pose.z_mm))
        orientation = multiply(multiply(self.rotation, turn_quaternion(pose.yaw_deg, pose.tilt_deg)), self.tool)
        ox, oy, oz = self.origin_mm
        return Pose(x + ox, y + oy, z + oz, *normalised(orientation)).check()

    def from_controller(self, pose: Pose, near_yaw_deg: float = 0.0) -> tuple[WorkPose, float]:
        """The TCP in the work-object frame, and the tool's angle to the vertical, about whichever axis, in deg.

        Yaw is taken within half a turn of ``near_yaw_deg``, so that it never jumps by a whole turn.
        """
        ox, oy, oz = self.origin_mm
        back = conjugate(self.rotation)
        x, y, z = rotate(back, (pose.x_mm - ox, pose.y_mm - oy, pose.z_mm - oz))
        qw, qx, qy, qz = multiply(multiply(back, normalised(pose.quaternion)), conjugate(self.tool))
        yaw_deg = math.degrees(2.0 * math.atan2(qz, qw))
        yaw_deg += 360.0 * round((near_yaw_deg - yaw_deg) / 360.0)
        leans_deg = math.degrees(2.0 * math.atan2(math.hypot(qx, qy), math.hypot(qw, qz)))
        tw, _, ty, _ = multiply(conjugate(turn_quaternion(yaw_deg)), (qw, qx, qy, qz))
        tilt_deg = math.degrees(2.0 * math.atan2(math.copysign(ty, ty * tw), abs(tw)))
        return WorkPose(x_mm=x, y_mm=y, z_mm=z, yaw_deg=yaw_deg, tilt_deg=tilt_deg), leans_deg
