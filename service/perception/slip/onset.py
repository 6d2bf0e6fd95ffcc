"""The first frame that captures motion of the held object.

At rest, the markers only jitter; averaged over 3 x 3 nodes the jitter is a few hundredths of a pixel. The object has
moved once the carried displacement exceeds the jitter since the reference was taken.
"""

from dataclasses import dataclass

import numpy as np

from service.perception.markers.field import MarkerField, median
from service.perception.slip.rigid import carried_px

_FLOOR_PITCH = 0.012  # the smallest motion that counts
_SIGMAS = 6.0  # above the jitter at rest, which is known after
_LEARN_N = 3  # frames


@dataclass(frozen=True, slots=True)
class Onset:
    """The frame that first shows motion: its stamp, its index after the reference (from 0), and the motion."""

    captured_ns: int
    index: int


class OnsetDetector:
    """Reports the onset once per :meth:`rearm`; ``update`` returns it from the frame of onset on, None before."""

    def __init__(self) -> None:
        self.disarm()

    def disarm(self) -> None:
        self._reference: MarkerField | None = None
        self._onset: Onset | None = None
        self._rest: list[float] = []
        self._index = -1

    def rearm(self, field: MarkerField) -> None:
        """Take ``field`` as the object's resting state."""
        self.disarm()
        self._reference = field if field.usable else None

    def update(self, field: MarkerField) -> Onset | None:
        """Classify one field; fields without new evidence count as frames but change nothing."""
        self._index += 1
        reference = self._reference
        if self._onset or reference is None or not field.usable or field.valid.shape != reference.valid.shape:
            return self._onset
        may = field.valid & reference.valid
        moved = carried_px(np.asarray(field.displacement_px - reference.displacement_px, np.float64), may)
        if moved > self._threshold(field.pitch_px):
            self._onset = Onset(field.captured_ns, self._index)
        else:
            self._rest = [*self._rest[-15:], moved]
        return self._onset

    def _threshold(self, pitch_px: float) -> float:
        floor = _FLOOR_PITCH * pitch_px
        if len(self._rest) < _LEARN_N:
            return 1.5 * floor
        rest = np.array(self._rest)
        middle = float(median(rest))
        spread = 1.4826 * float(median(np.abs(rest - middle)))
        return max(floor, middle + _SIGMAS * max(spread, 0.1 * floor))
