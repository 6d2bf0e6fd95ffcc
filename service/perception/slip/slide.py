"""Whether the held object slides out of the hand: a logistic of what both fingers' imprints and markers do.

What slides and is held lightly falls: the imprint changes against the markers, from frame to frame and over three of
them, loses relief rather than wins it, and neither relief nor a bulging grid of markers says that the grip is strong.
Many objects turn in a strong grip and stay. Weights and limit are fitted by `python -m simulation grasps`.
"""

import math
import operator
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from service.perception.slip.imprint import ImprintChange

TERMS = ("changed", "changed over three", "let go", "relief", "irregular")
WEIGHTS = (0.6101, 1.078, 3.8423, -2.0489, -2.6615)
BIAS = -2.3619  # the limit included
_LITTLE = 0.01
_IRREGULAR = 0.2  # pitch; more, or a grid that is not seen, says no more
_REGULAR = 0.02  # pitch, of all fingers; less was never seen, and says no more
_FAINT = 7.0  # percent, of all fingers; a fainter imprint is one of another light or gel, and no lighter grip


class SlideWitness:
    """Follows all fingers of a hand."""

    def __init__(self) -> None:
        self._changed = 0.0
        self._changes: list[ImprintChange] = []

    def update(self, fingers: Sequence[ImprintChange | None]) -> float | None:
        """How surely the object slides out, from 0 on surely enough; None where `terms` is."""
        terms = self.terms(fingers)
        return None if terms is None else slide_score(terms)

    def terms(self, fingers: Sequence[ImprintChange | None]) -> NDArray[np.float64] | None:
        """What the logistic reads, float64 [TERMS]; None until each finger's imprint was looked at anew.

        None of one finger, too, whose grip looks half as strong as it is.
        """
        changes = [finger for finger in fingers if finger is not None]
        if len(changes) < max(2, len(fingers)) or any(map(operator.is_, changes, self._changes)):
            return None
        self._changes = changes
        most = max(finger.changed for finger in changes)
        twice, self._changed = min(self._changed, most), most
        relief = math.hypot(*(finger.relief for finger in changes))
        irregular = sum(min(finger.irregular_pitch, _IRREGULAR) for finger in changes)
        return np.array(
            [
                math.log(_LITTLE + twice),
                math.log(_LITTLE + max(finger.changed_later for finger in changes)),
                sum(finger.let_go for finger in changes) / len(changes),
                math.log(1 + max(relief, _FAINT)),
                math.log(_LITTLE + max(irregular, _REGULAR)),
            ]
        )


def slide_score(terms: NDArray[np.float64]) -> float:
    """The logistic of :data:`TERMS`, 0 at the limit."""
    return float(np.dot(WEIGHTS, terms) + BIAS)
