"""Whether the held object slides out of the hand, from both fingers' imprints and markers.

A lightly held object that slides falls: the imprint changes against the markers, from frame to frame and over three of
them, loses relief rather than gaining it, and neither relief nor a bulging grid of markers indicates a strong grip. A
logistic of these five counts only where the imprints of all fingers move. Many objects turn in a strong grip and stay;
but one whose imprint has moved far over all fingers, however slowly, is on its way out. Weights and limits are fitted
by `python -m simulation grasps`.
"""

import math
import operator
from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from service.perception.slip.imprint import ImprintChange

TERMS = ("changed", "changed over three", "let go", "relief", "irregular", "moved", "walked")
READ_N = 5  # terms of the logistic
# Weights of these, their bias including the limit, and the logarithm of the pitches that are too far.
MODEL = np.array([0.6101, 1.078, 3.8423, -2.0489, -2.6615, -2.3619, -0.3735])
_MOVED = math.log(0.025)  # pitches; five times the apparent motion of the imprint of an object at rest
_MOVED_N = 3  # examined frames
_WALKED_N = 32  # examined frames, 3 to 4 s
_STILL = 1e-3
_LITTLE = 0.01
_IRREGULAR = 0.2  # pitch; more, or an invisible grid, adds no information
_REGULAR = 0.02  # pitch, of all fingers; less never occurred, and adds no information
_FAINT = 7.0  # percent, of all fingers; a fainter imprint means another light or gel, not a lighter grip


class SlideWitness:
    """Follows all fingers of a hand."""

    def __init__(self) -> None:
        self._changed = 0.0
        self._changes: list[ImprintChange] = []
        self._walks: deque[list[tuple[float, float]]] = deque(maxlen=_WALKED_N)

    def update(self, fingers: Sequence[ImprintChange | None]) -> float | None:
        """Evidence that the object slides out, sufficient from 0 on; None where `terms` is."""
        terms = self.terms(fingers)
        return None if terms is None else float(slide_score(terms))

    def terms(self, fingers: Sequence[ImprintChange | None]) -> NDArray[np.float64] | None:
        """Inputs of :func:`slide_score`, float64 [TERMS]; None until each finger's imprint has a new examined frame.

        Also None for one finger alone, whose grip looks half as strong as it is.
        """
        changes = [finger for finger in fingers if finger is not None]
        if len(changes) < max(2, len(fingers)):
            self._walks.clear()
            self._changed = 0.0
            return None
        if any(map(operator.is_, changes, self._changes)):
            return None
        self._changes = changes
        most = max(finger.changed for finger in changes)
        twice, self._changed = min(self._changed, most), most
        relief = math.hypot(*(finger.relief for finger in changes))
        irregular = sum(min(finger.irregular_pitch, _IRREGULAR) for finger in changes)
        self._walks.append([finger.walked_pitch for finger in changes])
        return np.array(
            [
                math.log(_LITTLE + twice),
                math.log(_LITTLE + max(finger.changed_later for finger in changes)),
                sum(finger.let_go for finger in changes) / len(changes),
                math.log(1 + max(relief, _FAINT)),
                math.log(_LITTLE + max(irregular, _REGULAR)),
                self._way(_MOVED_N),
                self._way(_WALKED_N),
            ]
        )

    def _way(self, looks: int) -> float:
        """Motion of the imprints over that many examined frames: mean logarithm of pitches."""
        ways = np.hypot(*np.sum(list(self._walks)[-looks:], 0).T)
        return float(np.log(_STILL + ways).mean())


def slide_score(terms: NDArray[np.float64], model: NDArray[np.float64] = MODEL) -> NDArray[np.float64]:
    """Score of a slide from `terms` [..., TERMS], 0 at the limit."""
    lightly = terms[..., :READ_N] @ model[:READ_N] + model[READ_N]
    return np.asarray(np.maximum(np.minimum(lightly, terms[..., -2] - _MOVED), terms[..., -1] - model[-1]))
