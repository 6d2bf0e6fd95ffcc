"""When and where the arm stopped: the time of the last new target, the overtravel, and the time of standstill.

Stamps are the machine's steady clock, so they compare with the capture stamps of the cameras.
"""

import time
from collections import deque
from dataclasses import asdict, dataclass

from simulation.cell.emulators.abb.cabinet import Cabinet

_DESCENT_MM_S = -1.0
_REST_MM_S = 0.1  # at this speed the lag leaves only a few micrometres to go


@dataclass(frozen=True, slots=True)
class Stop:
    """One end of a downward motion."""

    frozen_ns: int  # when the last target lower than the one before reached the controller
    rest_ns: int
    z_frozen_mm: float
    z_rest_mm: float

    @property
    def overtravel_mm(self) -> float:
        """Downward travel after the target was frozen."""
        return self.z_frozen_mm - self.z_rest_mm

    def as_dict(self) -> dict[str, float]:
        """Plain data, overtravel included."""
        return asdict(self) | {"overtravel_mm": self.overtravel_mm}


class StopWatch:
    """Called every EGM cycle; keeps the last hundred stops."""

    def __init__(self, cabinet: Cabinet) -> None:
        self.stops: deque[Stop] = deque(maxlen=100)
        self._cabinet = cabinet
        self._target = cabinet.arm.target
        self._frozen_ns = 0
        self._z_frozen_mm = 0.0
        self._descending = False

    def __call__(self) -> None:
        arm = self._cabinet.arm
        target, self._target = self._target, arm.target
        if arm.target.position_mm[2] < target.position_mm[2]:  # lowered further: not frozen yet
            self._frozen_ns, self._z_frozen_mm = time.monotonic_ns(), arm.pose.position_mm[2]
        if arm.velocity_mm_s[2] < _DESCENT_MM_S:
            self._descending = True
        elif self._descending and arm.velocity_mm_s[2] > -_REST_MM_S:
            self._descending = False
            stop = Stop(self._frozen_ns, time.monotonic_ns(), self._z_frozen_mm, arm.pose.position_mm[2])
            self.stops.append(stop)
