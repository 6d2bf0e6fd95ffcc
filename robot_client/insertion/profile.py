"""Jerk-limited motion of one scalar from rest to rest: the double S of seven segments."""

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Profile:
    """Way ``length`` (any unit) covered from rest to rest; ``ramp_s`` of constant jerk, ``rise_s`` to full speed."""

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
        """Way covered at ``time_s``; 0 before the start, ``length`` after the end; raises ValueError on NaN."""
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
        jerk, ramp = self.jerk, self.ramp_s
        if time_s <= ramp:
            return jerk * time_s**3 / 6.0
        acceleration = jerk * ramp
        if time_s <= self.rise_s - ramp:
            return acceleration / 6.0 * (3.0 * time_s**2 - 3.0 * ramp * time_s + ramp**2)
        return self._top_speed() * (time_s - self.rise_s / 2.0) + jerk * (self.rise_s - time_s) ** 3 / 6.0


def plan_profile(length: float, speed: float, acceleration: float, jerk: float) -> Profile:
    """The fastest double S over ``length`` >= 0 within the limits (all > 0); raises ValueError otherwise."""
    if not (length >= 0.0 and math.isfinite(length)) or not all(
        math.isfinite(v) and v > 0.0 for v in (speed, acceleration, jerk)
    ):
        raise ValueError(f"way {length} at {speed}, {acceleration}, {jerk}: expected a finite way and limits above 0")
    if speed * jerk < acceleration**2:
        ramp_s = math.sqrt(speed / jerk)
        rise_s = 2.0 * ramp_s
    else:
        ramp_s = acceleration / jerk
        rise_s = ramp_s + speed / acceleration
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
