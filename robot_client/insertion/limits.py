"""The last check before the wire: every target passes here, and a refusal gives its reason. Nothing is ever clamped."""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field, field_validator

from robot_client.insertion.geometry import WorkPose
from service.contract.frames import Contract
from service.contract.wire import MAX_ATTEMPTS

Motion = Literal["travel", "descend", "retract"]
Leg = tuple[float, float]
"""A leg of a descent: the height at which it ends, mm, and its speed, mm/s."""
Positive = Annotated[float, Field(gt=0)]


class LimitError(ValueError):
    """A motion that is not allowed; the text names the quantity, its value and its bound."""


class Limits(Contract):
    """Bounds in the work-object frame. The box holds the TCP; ``z_mm`` includes the lowest height ever commanded.

    ``max_tilt_deg``: angle of the tool to the vertical. ``max_straighten_deg``: tilt that the service may ask for, to
    hold an object upright that has turned in the hand; 0: none.
    """

    x_mm: tuple[float, float] = (-40.0, 40.0)
    y_mm: tuple[float, float] = (-20.0, 20.0)
    z_mm: tuple[float, float] = (5.0, 150.0)
    yaw_deg: tuple[float, float] = (-45.0, 45.0)
    max_tilt_deg: float = Field(default=2.0, gt=0, le=5)  # the first moves right the tool
    max_straighten_deg: float = Field(default=1.5, ge=0.0)
    max_speed_mm_s: Positive = 80.0
    max_descent_speed_mm_s: Positive = 15.0
    max_turn_deg_s: Positive = 60.0
    max_acceleration_mm_s2: Positive = 1500.0
    max_turn_acceleration_deg_s2: Positive = 1500.0
    max_dx_mm: Positive = 16.0
    max_dtheta_deg: Positive = 16.0
    max_attempts: int = Field(default=MAX_ATTEMPTS, ge=1, le=MAX_ATTEMPTS)
    max_correction_age_s: Positive = 5.0
    max_tracking_mm: Positive = 10.0

    @field_validator("yaw_deg")
    @classmethod
    def _within_a_turn(cls, yaw_deg: tuple[float, float]) -> tuple[float, float]:
        """Refuse more: a pose would have two yaws in the box, and the arm might turn all the way from one to it."""
        low, high = yaw_deg
        if high - low > 360.0:
            raise ValueError(f"from {low:g} to {high:g} is more than a whole turn")
        return yaw_deg

    @property
    def middle_yaw_deg(self) -> float:
        """The yaw of the box that is within half a turn of all others."""
        low, high = self.yaw_deg
        return low + (high - low) / 2.0


ARRIVED_MM = ARRIVED_DEG = 1.0  # further from its target an arm has not done its move, whatever it answers
_TOLERANCE = 1.0 + 1e-6
_INACCURACY = 0.1  # mm or deg by which an arm that was sent to the edge of the box may stand beyond it


def check_pose(limits: Limits, pose: WorkPose, name: str = "target", here: WorkPose | None = None) -> WorkPose:
    """``pose`` if it lies in the box; raises LimitError otherwise (also for non-finite values).

    ``here``: where the way to it begins. An arm that stands slightly beyond the box goes no further, but it may leave.
    """
    values = {"x_mm": pose.x_mm, "y_mm": pose.y_mm, "z_mm": pose.z_mm, "yaw_deg": pose.yaw_deg}
    for field_name, value in values.items():
        low, high = getattr(limits, field_name)
        if here is not None:
            low, high = _widened(low, high, getattr(here, field_name))
        if not (math.isfinite(value) and low <= value <= high):
            raise LimitError(f"{name} {field_name} = {value:.3f}, allowed {low:g} .. {high:g}")
    if not abs(pose.tilt_deg) <= limits.max_tilt_deg:
        raise LimitError(f"{name} tilt_deg = {pose.tilt_deg:.3f}, allowed up to {limits.max_tilt_deg:g} either way")
    return pose


def check_arrived(target: WorkPose, pose: WorkPose) -> None:
    """Raise LimitError if a move did not lead to its target: the next one would begin elsewhere, perhaps low down."""
    _check_near(target, pose, "the arm ended its move {} away from its target")


def check_descended(top: WorkPose, depth_mm: float, pose: WorkPose) -> None:
    """Raise LimitError for a pose that no descent by ``depth_mm`` leads through: its depth says nothing."""
    on_the_way = top.at_height(min(max(pose.z_mm, top.z_mm - depth_mm), top.z_mm))
    _check_near(on_the_way, pose, "the arm stands {} off its descent")


def _check_near(place: WorkPose, pose: WorkPose, text: str) -> None:
    away_mm, away_deg = place.distance_mm(pose), place.turn_deg(pose)
    if not (away_mm <= ARRIVED_MM and away_deg <= ARRIVED_DEG):
        away = text.format(f"{away_mm:.2f} mm and {away_deg:.2f} deg")
        raise LimitError(f"{away}, allowed {ARRIVED_MM:g} and {ARRIVED_DEG:g}")


def _widened(low: float, high: float, here: float) -> tuple[float, float]:
    """The bounds, or the place beyond one of them, where it is beyond it by no more than an arm is inaccurate."""
    return (min(low, here), max(high, here)) if max(low - here, here - high) <= _INACCURACY else (low, high)


def check_correction(limits: Limits, attempt: int, dx_mm: float, dtheta_deg: float, age_s: float) -> None:
    """Raise LimitError unless the correction is finite, small enough, recent enough and of an allowed attempt."""
    checks = (
        ("correction dx_mm", abs(dx_mm), limits.max_dx_mm),
        ("correction dtheta_deg", abs(dtheta_deg), limits.max_dtheta_deg),
        ("correction age_s", age_s, limits.max_correction_age_s),
        ("attempt", float(attempt), float(limits.max_attempts)),
    )
    for name, value, bound in checks:
        if not (math.isfinite(value) and value <= bound):
            raise LimitError(f"{name} = {value:.3f}, allowed up to {bound:g}")


def check_straightening(most_tilt_deg: float, tilt_deg: float) -> None:
    """Raise LimitError unless the service may ask for this tilt."""
    if not abs(tilt_deg) <= most_tilt_deg:
        raise LimitError(f"tilt_deg = {tilt_deg:.3f}, allowed up to {most_tilt_deg:g} either way")


def _slows_down(new: tuple[float, ...], old: tuple[float, ...]) -> bool:
    """True if ``new`` is ``old`` times a factor of 0..1: slowing down, as in a stop, is never refused."""
    square = sum(v * v for v in old)
    share = sum(a * b for a, b in zip(new, old, strict=True)) / square if square > 0.0 else 0.0
    return 0.0 <= share <= 1.0 and math.dist(new, [share * v for v in old]) <= 1e-6 * math.sqrt(square)


@dataclass(slots=True)
class StepGuard:
    """Watches the stream of targets: box, speed and acceleration between one target and the next.

    A target equal to the last one (a hold) is always allowed: stopping must never be refused.
    """

    limits: Limits
    last: WorkPose
    _speed: tuple[float, float, float] = (0.0, 0.0, 0.0)
    _turn_deg_s: tuple[float, float] = (0.0, 0.0)  # yaw and tilt
    _elapsed_s: float = 0.004

    def check(self, target: WorkPose, elapsed_s: float, motion: Motion) -> WorkPose:
        """``target`` if it may follow the last one after ``elapsed_s``; raises LimitError otherwise."""
        if target == self.last:
            self.rest()
            return target
        check_pose(self.limits, target, here=self.last)
        if not (math.isfinite(elapsed_s) and elapsed_s > 0.0):
            raise LimitError(f"target after {elapsed_s} s, expected a positive time step")
        step = (target.x_mm - self.last.x_mm, target.y_mm - self.last.y_mm, target.z_mm - self.last.z_mm)
        speed = (step[0] / elapsed_s, step[1] / elapsed_s, step[2] / elapsed_s)
        turns = (target.yaw_deg - self.last.yaw_deg, target.tilt_deg - self.last.tilt_deg)
        turn = (turns[0] / elapsed_s, turns[1] / elapsed_s)
        top = self.limits.max_descent_speed_mm_s if motion == "descend" else self.limits.max_speed_mm_s
        self._bound("speed mm/s", math.hypot(*speed), top)
        self._bound("turn deg/s", math.hypot(*turn), self.limits.max_turn_deg_s)
        between_s = (elapsed_s + self._elapsed_s) / 2.0  # both speeds are means over their step
        if not _slows_down((*speed, *turn), (*self._speed, *self._turn_deg_s)):
            change = math.dist(speed, self._speed) / between_s
            self._bound("acceleration mm/s2", change, self.limits.max_acceleration_mm_s2)
            change = math.dist(turn, self._turn_deg_s) / between_s
            self._bound("turn acceleration deg/s2", change, self.limits.max_turn_acceleration_deg_s2)
        self.last, self._speed, self._turn_deg_s, self._elapsed_s = target, speed, turn, elapsed_s
        return target

    def rest(self) -> None:
        """The target stands still from now on."""
        self._speed, self._turn_deg_s = (0.0, 0.0, 0.0), (0.0, 0.0)

    def _bound(self, name: str, value: float, bound: float) -> None:
        if not value <= bound * _TOLERANCE:
            raise LimitError(f"{name} = {value:.3f}, allowed up to {bound:g}")
