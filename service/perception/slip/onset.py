"""The first frame that captures motion of the held object.

At rest, the markers only jitter; averaged over 3 x 3 nodes the jitter is a few hundredths of a pixel. The object has
moved once the carried displacement exceeds the jitter since the reference was taken.
"""

import numpy as np

from service.perception.markers.field import MarkerField, median
from service.perception.slip.rigid import carried_px

_FLOOR_PITCH = 0.012  # the smallest motion that counts
_SIGMAS = 6.0  # above the jitter at rest, which is known after
_LEARN_N = 3  # frames


class OnsetDetector:
    """Finds the onset once per :meth:`rearm`, relative to the field given there."""

    def __init__(self) -> None:
        self._reference: MarkerField | None = None
        self._onset_ns: int | None = None
        self._rest: list[float] = []

    def rearm(self, field: MarkerField) -> None:
        """Take ``field`` as the object's resting state."""
        self._reference, self._onset_ns, self._rest = field if field.usable else None, None, []

    def update(self, field: MarkerField) -> int | None:
        """Capture stamp of the frame of onset, from that frame on; fields without new evidence change nothing."""
        onset_ns, reference = self._onset_ns, self._reference
        if onset_ns is not None or reference is None or not field.usable or field.valid.shape != reference.valid.shape:
            return onset_ns
        may = field.valid & reference.valid
        moved = carried_px(np.asarray(field.displacement_px - reference.displacement_px, np.float64), may)
        if moved > self._threshold(field.pitch_px):
            self._onset_ns = field.captured_ns
        else:
            self._rest = [*self._rest[-15:], moved]
        return self._onset_ns

    def _threshold(self, pitch_px: float) -> float:
        floor = _FLOOR_PITCH * pitch_px
        if len(self._rest) < _LEARN_N:
            return 1.5 * floor
        rest = np.array(self._rest)
        middle = float(median(rest))
        spread = 1.4826 * float(median(np.abs(rest - middle)))
        return max(floor, middle + _SIGMAS * max(spread, 0.1 * floor))
