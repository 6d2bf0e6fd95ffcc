"""Speed and height of the arm where no contact is possible: saves time without a faster touch. Pure.

The tops of the blocks lie ``clearance_mm`` below the approach as far as the plan knows, and where attempts stopped.
Around them a descent keeps the probing speed of ``ramps.descend``. Every leg is leased and watched for slip.
"""

from typing import NamedTuple

from pydantic import Field

from robot_client.insertion.limits import Leg, LimitError, Limits, Positive
from service.contract.frames import Contract
from service.contract.wire import PRESS_MM

LEAST_LEG_MM = 0.1  # an arm settles to less; a shorter leg might lead up


class Tops(NamedTuple):
    """Heights of the TCP between which the object meets the tops of the blocks, mm."""

    low_mm: float
    high_mm: float

    def with_stop(self, z_mm: float) -> "Tops":
        """The same with one more height at which an attempt stopped."""
        return Tops(min(self.low_mm, z_mm), max(self.high_mm, z_mm))


class Pace(Contract):
    """Fast parts of a descent, and the height of the arm between attempts.

    ``fast_mm_s``: speed away from the tops; None, or a speed no higher than probing: the probing speed all the way.
    ``fast_travel_mm``: the motion lease of a descent with fast legs, in addition to ``lease.travel_mm``. ``above_mm``
    and ``below_mm``: range around the tops in which the descent probes. ``lift_mm``: height above the tops to which an
    attempt that ended near them is raised, None for the approach height. ``press_mm``: press of an attempt after its
    touch.
    """

    fast_mm_s: Positive | None = 10.0
    fast_travel_mm: Positive = 1.5
    above_mm: float = Field(default=2.0, ge=1.0)  # uncertainty of the tops, and the press of an object
    below_mm: float = Field(default=4.0, ge=3.0)
    lift_mm: float | None = Field(default=3.0, ge=2.0)
    press_mm: float = Field(default=PRESS_MM, ge=0.6, le=3.0)  # as in the message `arm`

    def check(self, limits: Limits) -> None:
        """Raise LimitError for a fast speed beyond the limits."""
        if self.fast_mm_s is not None and not self.fast_mm_s <= limits.max_descent_speed_mm_s:
            allowed = f"allowed up to {limits.max_descent_speed_mm_s:g} (limits.max_descent_speed_mm_s)"
            raise LimitError(f"pace.fast_mm_s = {self.fast_mm_s:g}, {allowed}")

    def legs(self, start_mm: float, end_mm: float, probing_mm_s: float, tops: Tops) -> tuple[Leg, ...]:
        """The legs of a descent between two heights, slow around the tops; none if it is slow all the way."""
        if self.fast_mm_s is None or self.fast_mm_s <= probing_mm_s:
            return ()
        ways = (
            (tops.high_mm + self.above_mm, self.fast_mm_s),
            (tops.low_mm - self.below_mm, probing_mm_s),
            (end_mm, self.fast_mm_s),
        )
        legs, height_mm = list[Leg](), start_mm
        for until_mm, speed_mm_s in ways:
            lower_mm = until_mm if end_mm < until_mm - LEAST_LEG_MM else end_mm  # by the same sum: the end is a leg's
            if lower_mm < height_mm - LEAST_LEG_MM:
                legs.append((lower_mm, speed_mm_s))
                height_mm = lower_mm
        return () if all(speed_mm_s == probing_mm_s for _, speed_mm_s in legs) else tuple(legs)

    def up_to_mm(self, approach_mm: float, planned: Tops, tops: Tops, stop_mm: float) -> float:
        """The height to which an attempt stopped at ``stop_mm`` is raised before it is moved sideways.

        ``planned``: the plan's position of the tops. An object that went well below them stands between the blocks.
        """
        if self.lift_mm is None or stop_mm < planned.low_mm - self.below_mm:
            return approach_mm
        return min(approach_mm, tops.high_mm + self.lift_mm)


ONE_SPEED = Pace(fast_mm_s=None, lift_mm=None)
"""Down at the probing speed all the way, and up to the approach height."""
