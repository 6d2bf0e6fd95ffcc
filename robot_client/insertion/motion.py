"""From a commanded move to the next target, 250 times a second; shared by every arm driver. No I/O, no clock."""

import itertools
import math
from typing import Any, Literal, get_args

from pydantic import model_validator

from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.lease import PAUSE_S, Unwatched, check_leased
from robot_client.insertion.limits import Leg, LimitError, Limits, Motion, StepGuard, check_pose
from robot_client.insertion.profile import LegsProfile, Profile, plan_legs, plan_profile
from service.contract.frames import Contract

CYCLE_S = 0.004
MISSED_CYCLES = 3
TURN_DEG_S = 55.0  # no ramp turns faster, and the limits allow slightly more
LOST_S = 0.05  # time that a descent lost is reported from this on: a quarter of a millimetre at the probing speed
_RESUME_S = 0.05  # after a gap the motion resumes on a ramp of this duration, no steeper than its own
_SETTLE_MM = 0.03
_SETTLE_DEG = 0.03
_STILL_MM = 0.015  # within a window this small for SETTLE_S: at rest
_STILL_DEG = 0.01
SETTLE_S = 0.04

Settled = Literal["arrived", "standstill"]


class Ramp(Contract):
    """Speed, acceleration and jerk of one kind of motion, in mm; yaw follows the same profile in deg, to TURN_DEG_S."""

    speed_mm_s: float
    acceleration_mm_s2: float
    jerk_mm_s3: float


class Ramps(Contract):
    """Ramps of the arm in free air, while probing and on the way up. docs/pace.md gives the reasons."""

    travel: Ramp = Ramp(speed_mm_s=80.0, acceleration_mm_s2=300.0, jerk_mm_s3=5000.0)
    descend: Ramp = Ramp(speed_mm_s=5.0, acceleration_mm_s2=100.0, jerk_mm_s3=2000.0)
    retract: Ramp = Ramp(speed_mm_s=25.0, acceleration_mm_s2=200.0, jerk_mm_s3=4000.0)

    @model_validator(mode="before")
    @classmethod
    def _filled(cls, tables: Any) -> Any:
        """A ramp of which a table states some keys keeps the default for the others."""
        if not isinstance(tables, dict):
            return tables
        usual = {name: field.default.model_dump() for name, field in cls.model_fields.items()}
        return {
            name: {**usual[name], **given} if name in usual and isinstance(given, dict) else given
            for name, given in tables.items()
        }

    def of(self, motion: Motion) -> Ramp:
        return {"travel": self.travel, "descend": self.descend, "retract": self.retract}[motion]

    @property
    def unwatched_mm_s(self) -> float:
        """Highest speed of the motions in which nobody watches for touch: over, and straight up."""
        return max(self.travel.speed_mm_s, self.retract.speed_mm_s)

    def duration_s(self, start: WorkPose, end: WorkPose, motion: Motion) -> float:
        """Time from rest to rest, lag not counted."""
        return self.profile(start, end, motion).duration_s

    def profile(self, start: WorkPose, end: WorkPose, motion: Motion) -> Profile:
        """Profile over the longer of distance (mm) and turn (deg); raises ValueError for a ramp of zero."""
        ramp = self.of(motion)
        length = max(start.distance_mm(end), start.turn_deg(end) * max(1.0, ramp.speed_mm_s / TURN_DEG_S))
        return plan_profile(length, ramp.speed_mm_s, ramp.acceleration_mm_s2, ramp.jerk_mm_s3)

    def in_legs(self, start_mm: float, legs: tuple[Leg, ...]) -> LegsProfile:
        """Profile of a descent from a height; raises ValueError for legs that do not lead down."""
        heights = (start_mm, *(height_mm for height_mm, _ in legs))
        ways = [upper - lower for upper, lower in itertools.pairwise(heights)]
        speeds = [speed_mm_s for _, speed_mm_s in legs]
        return plan_legs(list(zip(ways, speeds, strict=True)), self.descend.acceleration_mm_s2, self.descend.jerk_mm_s3)


def check_ramps(limits: Limits, ramps: Ramps) -> None:
    """Raise LimitError for a ramp that the limits would interrupt in mid-motion, at full speed."""
    for motion in get_args(Motion):
        ramp: Ramp = ramps.of(motion)
        top = limits.max_descent_speed_mm_s if motion == "descend" else limits.max_speed_mm_s
        bounds = {"speed_mm_s": top, "acceleration_mm_s2": limits.max_acceleration_mm_s2, "jerk_mm_s3": math.inf}
        for name, bound in bounds.items():
            value = getattr(ramp, name)
            if not 0.0 < value <= bound:
                raise LimitError(f"ramps.{motion}.{name} = {value:g}, the limits allow above 0 and up to {bound:g}")
        _check_turns(limits, motion, ramp)


def _check_turns(limits: Limits, motion: Motion, ramp: Ramp) -> None:
    """The same for a turn, which a ramp makes with its own figures in degrees, slower where they exceed TURN_DEG_S."""
    slower = max(1.0, ramp.speed_mm_s / TURN_DEG_S)
    turns = {"max_turn_deg_s": "speed_mm_s", "max_turn_acceleration_deg_s2": "acceleration_mm_s2"}
    for limit, name in turns.items():
        bound, value = getattr(limits, limit), getattr(ramp, name) / slower
        if not value <= bound:
            why = f"limits.{limit} = {bound:g}, and turns reach {value:g} on ramps.{motion}"
            raise LimitError(f"{why}: lower ramps.{motion}.{name}")


def check_legs(limits: Limits, motion: Motion, start: WorkPose, end: WorkPose, legs: tuple[Leg, ...]) -> None:
    """Raise LimitError for legs that are too fast, lead up, end elsewhere, or belong to no descent."""
    if not legs:
        return
    top = limits.max_descent_speed_mm_s
    if motion != "descend" or legs[-1][0] != end.z_mm or not all(0.0 < speed <= top for _, speed in legs):
        raise LimitError(f"{motion} to z_mm = {end.z_mm:g} in legs {legs}: expected a descent, up to {top:g} mm/s")
    heights_mm = [start.z_mm, *(height_mm for height_mm, _ in legs)]
    if any(lower_mm >= upper_mm for upper_mm, lower_mm in itertools.pairwise(heights_mm)):
        raise LimitError(f"descent from z_mm = {start.z_mm:g} in legs {legs}: expected each one to lead down")


class MotionGuide:
    """Holds the target, moves it along the commanded line and reports when the arm has settled on it."""

    def __init__(self, limits: Limits, ramps: Ramps, start: WorkPose) -> None:
        self.limits = limits
        self.ramps = ramps
        self.target = start
        self._guard = StepGuard(limits, start)
        self._motion: Motion = "travel"
        self._start = self._end = start
        self._profile: Profile | LegsProfile | None = None
        self._until_s: float | None = None
        self.pauses_n = 0
        self._paused_s: float | None = None
        self._walked_s = 0.0
        self._rate = 1.0
        self._lost_s = 0.0
        self._resume_s = _RESUME_S
        self._waiting: Settled | None = None
        self._still: WorkPose | None = None
        self._still_since_s = 0.0

    @property
    def moving(self) -> bool:
        """True while the target moves."""
        return self._profile is not None

    def move(self, end: WorkPose, motion: Motion, until_s: float | None = None, legs: tuple[Leg, ...] = ()) -> None:
        """Begin a straight move to ``end``; raises LimitError and changes nothing if the end is not allowed.

        A descent moves only before ``until_s``, on the clock passed to :meth:`advance`, and requires it. ``legs`` give
        its speed on each of them.
        """
        check_leased(motion, until_s)
        check_pose(self.limits, end, here=self.target)
        check_legs(self.limits, motion, self.target, end, legs)
        profile = self.ramps.in_legs(self.target.z_mm, legs) if legs else self.ramps.profile(self.target, end, motion)
        self._guard.rest()
        self._start, self._end, self._motion = self.target, end, motion
        self._profile = profile
        self._resume_s = self._resumes_in_s(max((speed for _, speed in legs), default=0.0))
        self._walked_s, self._rate, self._lost_s, self._until_s = 0.0, 1.0, 0.0, until_s
        self._waiting, self._still, self._paused_s = "arrived", None, None

    def _resumes_in_s(self, fastest_mm_s: float) -> float:
        """Time in which the move regains its speed: as on its own ramp, and thus within the limits."""
        ramp = self.ramps.of(self._motion)
        most = min(self.limits.max_acceleration_mm_s2, self.limits.max_turn_acceleration_deg_s2)
        spare = max(most - ramp.acceleration_mm_s2, 0.01 * most)
        return max(_RESUME_S, max(ramp.speed_mm_s, fastest_mm_s) / min(spare, ramp.acceleration_mm_s2))

    def renew(self, until_s: float) -> None:
        """Let the descent under way move until then."""
        if self._until_s is not None:
            self._until_s = max(self._until_s, until_s)

    def hold(self) -> None:
        """Freeze the target in place and report when the arm is at rest; idempotent."""
        if self._waiting != "standstill":
            self._still = None
        self._profile = None
        self._waiting = "standstill"

    def advance(self, elapsed_s: float, now_s: float) -> WorkPose:
        """Target after ``elapsed_s``; raises LimitError (target unchanged) if it may not be sent.

        The target stands while the lease of a descent is over at ``now_s`` (``time.monotonic``); after PAUSE_S of that,
        Unwatched is raised.

        Over a gap of more than MISSED_CYCLES the target advances by their travel at most, then regains speed on a ramp.
        """
        if self._profile is None or elapsed_s <= 0.0:
            return self.target
        if self._until_s is not None and now_s >= self._until_s:
            return self._pause(self._until_s, elapsed_s, now_s)
        self._paused_s, walked_s = None, self._walked_s
        if elapsed_s > (MISSED_CYCLES + 0.5) * CYCLE_S:
            self._rate = min(self._rate, MISSED_CYCLES * CYCLE_S / elapsed_s)
            self._walked_s += elapsed_s * self._rate
        else:
            # The speed grows during the step, not after it: otherwise a long step before a short one is a jolt.
            before, self._rate = self._rate, min(1.0, self._rate + elapsed_s / self._resume_s)
            self._walked_s += elapsed_s * (before + self._rate) / 2.0
        self._lost_s += elapsed_s - (self._walked_s - walked_s)
        share = self._profile.position(self._walked_s) / self._profile.length if self._profile.length > 0 else 1.0
        target = self._end if share >= 1.0 else self._start.towards(self._end, share)
        self.target = self._guard.check(target, elapsed_s, self._motion)
        if self._walked_s >= self._profile.duration_s:
            self._profile = None
        return self.target

    def take_lost_s(self) -> float:
        """Time by which gaps have delayed the descent since the last call, s; 0 below LOST_S. No pause counts."""
        if self._motion != "descend" or self._lost_s < LOST_S:
            return 0.0
        lost_s, self._lost_s = self._lost_s, 0.0
        return lost_s

    def _pause(self, since_s: float, elapsed_s: float, now_s: float) -> WorkPose:
        """Stand; renewals that come too late to move on do not prolong the pause."""
        if self._paused_s is None:
            self._lost_s += max(0.0, elapsed_s - (now_s - since_s))  # a gap before the lease ended
            self._paused_s, self._rate = since_s, 0.0
            self.pauses_n += 1
        if now_s - self._paused_s >= PAUSE_S:
            ago_ms = (now_s - self._paused_s) * 1e3
            raise Unwatched(f"no frame was judged in time: the lease ended {ago_ms:.0f} ms ago")
        self._guard.rest()
        return self.target

    def observe(self, measured: WorkPose, now_s: float) -> Settled | None:
        """How the arm has settled, reported once per command: "arrived" at its end or "standstill" after a hold."""
        if self._waiting is None or self.moving:
            return None
        near = self._still is not None and (
            self._still.distance_mm(measured) <= _STILL_MM and self._still.turn_deg(measured) <= _STILL_DEG
        )
        on_target = self.target.distance_mm(measured) <= _SETTLE_MM and self.target.turn_deg(measured) <= _SETTLE_DEG
        if not near or (self._waiting == "arrived" and not on_target):
            self._still, self._still_since_s = measured, now_s
            return None
        if now_s - self._still_since_s < SETTLE_S:
            return None
        settled, self._waiting = self._waiting, None
        return settled
