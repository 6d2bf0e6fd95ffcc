"""How the arm follows a guide: first-order lag with limits on speed and acceleration, and a braking ramp for stops.

Poses are in the work-object frame, mm; quaternions are (w, x, y, z). Everything is plain floats: this runs at 250 Hz.
"""

import math
from dataclasses import dataclass, field

from robot_client.insertion.geometry import TOOL_DOWN, Quaternion, Vector, conjugate, multiply, normalised


def rotation_between(start: Quaternion, end: Quaternion) -> Vector:
    """Rotation vector (rad) that takes ``start`` to ``end`` the short way; exact at any angle."""
    w, x, y, z = multiply(end, conjugate(start))
    sine = math.sqrt(x * x + y * y + z * z)
    if sine < 1e-12:
        return (0.0, 0.0, 0.0)
    angle = 2.0 * math.atan2(sine, abs(w))
    scale = math.copysign(angle / sine, w)
    return (x * scale, y * scale, z * scale)


def rotated(q: Quaternion, rotation_rad: Vector) -> Quaternion:
    """``q`` turned by a rotation vector given in the fixed frame."""
    angle = math.sqrt(sum(c * c for c in rotation_rad))
    if angle < 1e-15:
        return q
    s = math.sin(angle / 2.0) / angle
    turn = (math.cos(angle / 2.0), rotation_rad[0] * s, rotation_rad[1] * s, rotation_rad[2] * s)
    return normalised(multiply(turn, q))


def tool_down(yaw_deg: float) -> Quaternion:
    """The tool pointing down, turned by ``yaw_deg`` about the work object's z."""
    half = math.radians(yaw_deg) / 2.0
    return (0.0, math.cos(half), math.sin(half), 0.0)


@dataclass(frozen=True, slots=True)
class Pose:
    """TCP pose in the work-object frame."""

    position_mm: Vector
    quaternion: Quaternion = TOOL_DOWN

    @property
    def yaw_deg(self) -> float:
        """Direction of the tool's x axis seen from above."""
        w, x, y, z = self.quaternion
        return math.degrees(math.atan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z)))

    @property
    def lean_deg(self) -> float:
        """Rotation of the tool about the axis along which its fingers close; 0 where its x axis is level."""
        w, x, y, z = self.quaternion
        return math.degrees(math.asin(max(-1.0, min(1.0, 2.0 * (w * y - x * z)))))

    @property
    def tilt_deg(self) -> float:
        """Angle between the tool's z axis and the vertical, whichever way the tool frame points."""
        _, x, y, _ = self.quaternion
        return math.degrees(math.acos(min(1.0, abs(1.0 - 2.0 * (x * x + y * y)))))


@dataclass(frozen=True, slots=True)
class MotionLimits:
    """Limits of the arm under guidance: lag of the controller, speed and acceleration, and its stop ramp."""

    lag_s: float = 0.020
    speed_mm_s: float = 250.0
    acceleration_mm_s2: float = 5000.0
    turn_rad_s: float = 1.5
    turn_acceleration_rad_s2: float = 30.0
    stop_deceleration_mm_s2: float = 8000.0
    stop_turn_deceleration_rad_s2: float = 60.0


_STEP_S = 0.002


def _towards(gap: Vector, velocity: Vector, lag_s: float, top: float, ramp: float, step_s: float) -> Vector:
    """New velocity of a point ``gap`` away from its target: exact lag where no limit binds, else the limit."""
    distance = math.sqrt(gap[0] ** 2 + gap[1] ** 2 + gap[2] ** 2)
    wanted = distance * -math.expm1(-step_s / lag_s) / step_s
    wanted = min(wanted, top, math.sqrt(2.0 * ramp * distance))
    scale = wanted / distance if distance > 0.0 else 0.0
    change = (gap[0] * scale - velocity[0], gap[1] * scale - velocity[1], gap[2] * scale - velocity[2])
    size = math.sqrt(change[0] ** 2 + change[1] ** 2 + change[2] ** 2)
    share = min(1.0, ramp * step_s / size) if size > 0.0 else 0.0
    return (velocity[0] + change[0] * share, velocity[1] + change[1] * share, velocity[2] + change[2] * share)


def _braked(velocity: Vector, ramp: float, step_s: float) -> Vector:
    speed = math.sqrt(velocity[0] ** 2 + velocity[1] ** 2 + velocity[2] ** 2)
    scale = max(0.0, 1.0 - ramp * step_s / speed) if speed > 0.0 else 0.0
    return (velocity[0] * scale, velocity[1] * scale, velocity[2] * scale)


@dataclass(slots=True)
class Follower:
    """The arm: it follows ``target`` while ``braking`` is off and brakes to rest on its ramp while it is on."""

    pose: Pose
    limits: MotionLimits = field(default_factory=MotionLimits)
    target: Pose = field(init=False)
    braking: bool = True
    speed_share: float = 1.0
    velocity_mm_s: Vector = (0.0, 0.0, 0.0)
    turn_rad_s: Vector = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        self.target = self.pose

    @property
    def at_rest(self) -> bool:
        """No motion left, to 1 um/s and 1 urad/s."""
        return all(abs(v) < 1e-3 for v in self.velocity_mm_s) and all(abs(v) < 1e-6 for v in self.turn_rad_s)

    def hold(self) -> None:
        """Forget the target and hold the arm's present pose (after braking)."""
        self.target = self.pose

    def advance(self, elapsed_s: float) -> None:
        """Move for ``elapsed_s`` of real time, in steps of at most 2 ms."""
        while elapsed_s > 1e-9:
            step_s = min(_STEP_S, elapsed_s)
            self._step(step_s)
            elapsed_s -= step_s

    def _step(self, step_s: float) -> None:
        limits = self.limits
        if self.braking:
            self.velocity_mm_s = _braked(self.velocity_mm_s, limits.stop_deceleration_mm_s2, step_s)
            self.turn_rad_s = _braked(self.turn_rad_s, limits.stop_turn_deceleration_rad_s2, step_s)
        else:
            p, t = self.pose.position_mm, self.target.position_mm
            top = limits.speed_mm_s * self.speed_share
            gap = (t[0] - p[0], t[1] - p[1], t[2] - p[2])
            self.velocity_mm_s = _towards(gap, self.velocity_mm_s, limits.lag_s, top, limits.acceleration_mm_s2, step_s)
            turn = rotation_between(self.pose.quaternion, self.target.quaternion)
            top = limits.turn_rad_s * self.speed_share
            ramp = limits.turn_acceleration_rad_s2
            self.turn_rad_s = _towards(turn, self.turn_rad_s, limits.lag_s, top, ramp, step_s)
        v, w, p = self.velocity_mm_s, self.turn_rad_s, self.pose.position_mm
        position = (p[0] + v[0] * step_s, p[1] + v[1] * step_s, p[2] + v[2] * step_s)
        turned = rotated(self.pose.quaternion, (w[0] * step_s, w[1] * step_s, w[2] * step_s))
        self.pose = Pose(position, turned)
