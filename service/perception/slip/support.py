"""Whether something other than the fingers bears the held object, from the direction of its load on the gels.

Friction holds an object by pulling each gel's markers one way. An object that slips out still pulls them that way, up
to the frame in which it is gone. One that is put down, or taken, pushes them the other way before the fingers let go.
"""

from collections import deque
from collections.abc import Sequence

import numpy as np

from service.perception.slip.open_gel import HOME_PITCH
from service.perception.slip.rigid import Float64

_KNOWN_N = 4  # frames from which a load is known
_REMEMBERED_N = 30  # frames whose median is the load; one that stays reversed becomes the load


class Support:
    """Follows the loads on all fingers (`OpenGel.load`) during one grasp."""

    def __init__(self) -> None:
        self._loads: list[deque[Float64]] = []
        self._reversed: list[bool] = []

    @property
    def borne(self) -> bool:
        """Whether the load on any finger has reversed and not yet returned."""
        return any(self._reversed)

    def update(self, loads: Sequence[Float64 | None], *, sliding: bool) -> None:
        """Take a frame's loads, None where a gel has no say; what swings while it slides is not borne by anything."""
        if len(self._loads) != len(loads):
            self._loads, self._reversed = [deque(maxlen=_REMEMBERED_N) for _ in loads], [False] * len(loads)
        for k, (load, known) in enumerate(zip(loads, self._loads, strict=True)):
            if load is None:
                continue
            along = _along(load, known)
            if along > HOME_PITCH or (along < -HOME_PITCH and not sliding):
                self._reversed[k] = along < 0
            known.append(load)


def _along(load: Float64, known: deque[Float64]) -> float:
    """Component of a load along the usual one, in pitches; 0 where none is known, or within what open gels show."""
    if len(known) < _KNOWN_N:
        return 0.0
    usual = np.median(known, 0)
    length = float(np.hypot(*usual))
    return float(load @ usual) / length if length > HOME_PITCH else 0.0
