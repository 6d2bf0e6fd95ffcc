"""The motion lease: how far the arm may go on after the last frame that the service judged. Pure, without a clock.

The bound is a distance, not a time: from the capture of the newest judged frame to standstill the arm may travel
``travel_mm``. The arm's stopping distance is part of it, and so is the uncertainty of the service's clock.

At the end of a lease the target stands. A frame judged soon after lets it move on: a short gap in the pictures costs
time, not the insertion. ``PAUSE_S`` without a judged frame ends the attempt.
"""

from dataclasses import dataclass

from robot_client.insertion.limits import LimitError, Motion, Positive
from service.contract import wire
from service.contract.frames import Contract

SLOW_MM, FAST_S = 1.5, 0.1  # largest travel that may be requested: 1.5 mm, or from 15 mm/s on the travel in 0.1 s
FRAMES_N, HANDLING_S = 1.5, 0.02  # a lease lasts this many frame periods, plus this time for transport and judging
PAUSE_S = 0.25  # the target of a descent stands this long without a lease before the arm holds for good
_DRIFT = 2e-4  # two quartz clocks may drift apart this fast
_ROUNDING_S = 1e-6


class Unwatched(LimitError):  # noqa: N818 it says what is, the driver turns it into a Failure event
    """The lease of a descent is over."""


class Lease(Contract):
    """``travel_mm`` from a frame's capture to standstill, including ``stop_lag_s`` at full speed.

    ``stop_lag_s`` is from the last lowered target to standstill: the arm's lag behind its targets, plus a cycle. A
    commissioning measures it together with the cameras' latency, which no stamp shows (:meth:`late_by`).
    """

    travel_mm: Positive = SLOW_MM
    stop_lag_s: Positive = 0.04

    def lasts_s(self, speed_mm_s: float) -> float:
        """Largest age of the newest judged frame while the target still moves at ``speed_mm_s``."""
        return self.travel_mm / speed_mm_s - self.stop_lag_s

    def at_most(self, speed_mm_s: float) -> "Lease":
        """This lease, limited to the largest one allowed at that speed."""
        return self.model_copy(update={"travel_mm": min(self.travel_mm, max(SLOW_MM, FAST_S * speed_mm_s))})

    def late_by(self, late_s: float | None) -> "Lease":
        """This lease, with the lateness of pictures and arm as measured, if that is longer than its stop lag."""
        return self.model_copy(update={"stop_lag_s": max(self.stop_lag_s, late_s or 0.0)})

    def check(self, speed_mm_s: float) -> None:
        """Raise LimitError for a travel above the limit of all cells, or a lag that uses up all of it."""
        self.check_travel(speed_mm_s)
        if not self.bears(speed_mm_s):
            lag = f"{self.stop_lag_s * 1e3:.0f} ms of stop lag"
            slower = (
                f"descend more slowly than {self.travel_mm / (HANDLING_S + self.stop_lag_s):.1f} mm/s (ramps.descend)"
            )
            used = f"lease.travel_mm = {self.travel_mm:g} is used up by {lag} at {speed_mm_s:g} mm/s"
            raise LimitError(f"{used}; {slower}")

    def check_travel(self, speed_mm_s: float) -> None:
        """Raise LimitError for a travel above the limit of all cells."""
        most_mm = max(SLOW_MM, FAST_S * speed_mm_s)
        if not self.travel_mm <= most_mm:
            where = f"allowed up to {most_mm:g} at {speed_mm_s:g} mm/s"
            raise LimitError(f"lease.travel_mm = {self.travel_mm:g}, {where}")

    def bears(self, speed_mm_s: float) -> bool:
        """Whether the stop lag leaves time to judge a frame."""
        return self.lasts_s(speed_mm_s) > HANDLING_S

    def check_rate(self, speed_mm_s: float, camera: wire.CameraEntry) -> None:
        """Raise LimitError for a camera too slow for this speed: descend more slowly then, never on a longer lease."""
        if camera.frame_rate_hz is None:
            return
        fastest_mm_s = self.fastest_mm_s(camera.frame_rate_hz)
        if speed_mm_s > fastest_mm_s:
            lasts_ms = self.lasts_s(speed_mm_s) * 1e3
            raise LimitError(
                f"the {camera.finger} camera gives {camera.frame_rate_hz:.1f} frames a second: too few for a lease of"
                f" {lasts_ms:.0f} ms; descend at {fastest_mm_s:.1f} mm/s or slower (ramps.descend)"
            )

    def fastest_mm_s(self, rate_hz: float) -> float:
        """The fastest descent on this lease with cameras of ``rate_hz``."""
        return self.travel_mm / (FRAMES_N / rate_hz + HANDLING_S + self.stop_lag_s)

    def fastest_legs_mm_s(self, rate_hz: float) -> float:
        """As `fastest_mm_s`, if a lease longer than that speed allows is shortened."""
        fastest_mm_s = self.fastest_mm_s(rate_hz)
        shortened = self.at_most(fastest_mm_s)
        return fastest_mm_s if shortened == self else self.at_most(0.0).fastest_mm_s(rate_hz)


def check_leased(motion: Motion, until_s: float | None) -> None:
    """Raise LimitError for a descent without a lease, and for any other move with one."""
    if (until_s is None) == (motion == "descend"):
        raise LimitError(f"{motion} with a lease of {until_s}: a descent has one, and nothing else")


@dataclass(frozen=True, slots=True)
class ClockMap:
    """Our monotonic clock is the service's plus an offset within [``earliest_s``, ``latest_s``], as of ``at_s``."""

    earliest_s: float
    latest_s: float
    at_s: float

    @classmethod
    def read(cls, clock: wire.Clock, at_s: float) -> "ClockMap":
        """From one answer, received at ``at_s``: the service's reading lies between our question and now."""
        return cls((clock.sent_ns - clock.service_ns) * 1e-9, at_s - clock.service_ns * 1e-9, at_s)

    def narrowed(self, other: "ClockMap") -> "ClockMap | None":
        """Both readings combined; None if they contradict each other, because a clock stopped or jumped."""
        drift_s = _DRIFT * max(0.0, other.at_s - self.at_s)
        earliest_s = max(self.earliest_s - drift_s, other.earliest_s)
        latest_s = min(self.latest_s + drift_s, other.latest_s)
        return None if earliest_s > latest_s + _ROUNDING_S else ClockMap(earliest_s, latest_s, other.at_s)

    @property
    def uncertainty_s(self) -> float:
        """Uncertainty of the offset: the shortest round trip, and the drift since."""
        return self.latest_s - self.earliest_s

    def ours_s(self, service_ns: int, at_s: float) -> float:
        """The earliest time of a service stamp on our clock: the uncertainty is counted as age."""
        return service_ns * 1e-9 + self.earliest_s - _DRIFT * max(0.0, at_s - self.at_s)
