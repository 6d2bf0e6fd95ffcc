"""Jerk-limited motion of one scalar from rest to rest: the double S of seven segments, or several legs in one go."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Profile:
    """Distance ``length`` (any unit), from rest to rest; ``ramp_s`` of constant jerk, ``rise_s`` to full speed."""

    length: float
    jerk: float
    ramp_s: float
    rise_s: float
    cruise_s: float

    @property
    def duration_s(self) -> float:
        """From start to standstill."""
        return 2.0 * self.rise_s + self.cruise_s

    def position(self, time_s: float) -> float:
        """Distance covered at ``time_s``; 0 before the start, ``length`` after the end; raises ValueError on NaN."""
        if math.isnan(time_s):
            raise ValueError("position asked for at a time that is no number")
        if time_s <= 0.0:
            return 0.0
        if time_s >= self.duration_s:
            return self.length
        if time_s <= self.rise_s:
            return self._rising(time_s)
        if time_s <= self.rise_s + self.cruise_s:
            return self._rising(self.rise_s) + self._top_speed() * (time_s - self.rise_s)
        return self.length - self._rising(self.duration_s - time_s)

    def _top_speed(self) -> float:
        return self.jerk * self.ramp_s * (self.rise_s - self.ramp_s)

    def _rising(self, time_s: float) -> float:
        return _risen(time_s, self.jerk, self.ramp_s, self.rise_s)


def _risen(time_s: float, jerk: float, ramp_s: float, rise_s: float) -> float:
    """Distance covered while the speed rises from rest for ``rise_s``."""
    if time_s <= ramp_s:
        return jerk * time_s**3 / 6.0
    if time_s <= rise_s - ramp_s:
        return jerk * ramp_s / 6.0 * (3.0 * time_s**2 - 3.0 * ramp_s * time_s + ramp_s**2)
    return jerk * ramp_s * (rise_s - ramp_s) * (time_s - rise_s / 2.0) + jerk * (rise_s - time_s) ** 3 / 6.0


def _rise(speed: float, acceleration: float, jerk: float) -> tuple[float, float]:
    """Time of constant jerk, and time to gain ``speed``."""
    if speed * jerk < acceleration**2:
        ramp_s = math.sqrt(speed / jerk)
        return ramp_s, 2.0 * ramp_s
    ramp_s = acceleration / jerk
    return ramp_s, ramp_s + speed / acceleration


def plan_profile(length: float, speed: float, acceleration: float, jerk: float) -> Profile:
    """The fastest double S over ``length`` >= 0 within the limits (all > 0); raises ValueError otherwise."""
    if not (length >= 0.0 and math.isfinite(length)) or not all(
        math.isfinite(v) and v > 0.0 for v in (speed, acceleration, jerk)
    ):
        raise ValueError(f"way {length} at {speed}, {acceleration}, {jerk}: expected a finite way and limits above 0")
    ramp_s, rise_s = _rise(speed, acceleration, jerk)
    cruise_s = length / speed - rise_s
    if cruise_s < 0.0:  # the top speed is not reached
        cruise_s = 0.0
        ramp_s = acceleration / jerk
        rise_s = ramp_s / 2.0 + math.sqrt(ramp_s**2 / 4.0 + length / acceleration)
        if rise_s < 2.0 * ramp_s:
            ramp_s = math.cbrt(length / (2.0 * jerk))
            rise_s = 2.0 * ramp_s
    profile = Profile(length, jerk, ramp_s, rise_s, cruise_s)
    if not math.isfinite(profile.duration_s):
        raise ValueError(f"way {length} at {speed}, {acceleration}, {jerk} would take for ever")
    return profile


@dataclass(frozen=True, slots=True)
class _Stretch:
    """Part of a distance: from one speed to another on an S, or at one speed."""

    before: float
    after: float
    duration_s: float
    jerk: float = 0.0
    ramp_s: float = 0.0

    @property
    def way(self) -> float:
        return 0.5 * (self.before + self.after) * self.duration_s

    def position(self, time_s: float) -> float:
        if self.before == self.after:
            return self.before * time_s
        gained = _risen(time_s, self.jerk, self.ramp_s, self.duration_s)
        return self.before * time_s + math.copysign(gained, self.after - self.before)


@dataclass(frozen=True, slots=True)
class LegsProfile:
    """Distance ``length`` from rest to rest in one motion, with different speeds on its legs."""

    length: float
    stretches: tuple[_Stretch, ...]

    @property
    def duration_s(self) -> float:
        """From start to standstill."""
        return sum(stretch.duration_s for stretch in self.stretches)

    def position(self, time_s: float) -> float:
        """Distance covered at ``time_s``; 0 before the start, ``length`` after the end; raises ValueError on NaN."""
        if math.isnan(time_s):
            raise ValueError("position asked for at a time that is no number")
        way, left_s = 0.0, max(0.0, time_s)
        for stretch in self.stretches:
            if left_s < stretch.duration_s:
                return min(self.length, way + stretch.position(left_s))
            way, left_s = way + stretch.way, left_s - stretch.duration_s
        return self.length

    def speeds(self) -> list[tuple[float, float, float]]:
        """(time, distance, speed): the approximate speed from there on, a change of it being placed at its middle."""
        changes: list[tuple[float, float, float]] = []
        at_s = 0.0
        for stretch in self.stretches:
            if stretch.before != stretch.after > 0.0:
                changed_s = at_s + 0.5 * stretch.duration_s if changes else 0.0
                changes.append((changed_s, self.position(changed_s), stretch.after))
            at_s += stretch.duration_s
        return changes


Leg = tuple[float, float]
"""Length and top speed of a leg."""


def plan_legs(legs: Sequence[Leg], acceleration: float, jerk: float) -> LegsProfile:
    """One motion from rest to rest, nowhere faster than the leg there: speeds change within the faster of two legs.

    A leg too short for that is merged with its slower neighbour. Raises ValueError for a length, a speed or a limit
    that is not finite and above 0.
    """
    if not legs or not all(math.isfinite(v) and v > 0.0 for v in (*itertools.chain(*legs), acceleration, jerk)):
        raise ValueError(f"legs {list(legs)} at {acceleration}, {jerk}: expected finite ways and limits above 0")
    speeds = [0.0, *(min(a[1], b[1]) for a, b in itertools.pairwise(legs)), 0.0]
    stretches: list[_Stretch] = []
    for place, leg in enumerate(legs):
        across = _across(leg, speeds[place], speeds[place + 1], acceleration, jerk)
        if across is None:
            return plan_legs(_merged(legs, place), acceleration, jerk)
        stretches += across
    return LegsProfile(sum(way for way, _ in legs), tuple(s for s in stretches if s.duration_s > 0.0))


def _merged(legs: Sequence[Leg], place: int) -> list[Leg]:
    """Leg ``place`` with the slower of its neighbours, at the lower speed."""
    beside = min((k for k in (place - 1, place + 1) if 0 <= k < len(legs)), key=lambda k: legs[k][1])
    first = min(place, beside)
    (way, speed), (other_way, other_speed) = legs[first], legs[first + 1]
    return [*legs[:first], (way + other_way, min(speed, other_speed)), *legs[first + 2 :]]


def _across(leg: Leg, enters: float, leaves: float, acceleration: float, jerk: float) -> list[_Stretch] | None:
    """Over a leg as fast as possible; None if it is too short to change its speed."""
    way, top = leg

    def changes(peak: float) -> tuple[_Stretch, _Stretch]:
        return _change(enters, peak, acceleration, jerk), _change(peak, leaves, acceleration, jerk)

    def fits(peak: float) -> bool:
        return sum(change.way for change in changes(peak)) <= way

    low, high = max(enters, leaves), top
    if not fits(low):
        return None
    for _ in range(0 if fits(top) else 60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if fits(middle) else (low, middle)
    peak = top if fits(top) else low
    up, down = changes(peak)
    return [up, _Stretch(peak, peak, max(0.0, way - up.way - down.way) / peak), down]


def _change(before: float, after: float, acceleration: float, jerk: float) -> _Stretch:
    if before == after:
        return _Stretch(before, after, 0.0)
    ramp_s, rise_s = _rise(abs(after - before), acceleration, jerk)
    return _Stretch(before, after, rise_s, jerk, ramp_s)
