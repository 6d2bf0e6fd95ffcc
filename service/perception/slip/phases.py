"""The phases of a grasp: open, contact, hold, slip, lost; of a finger alone, and of all fingers together.

A grasp is what at least one finger still touches, so one finger that lets go for a while is no loss. It is lost once
all fingers are empty in two frames that follow each other.
"""

from collections import deque
from collections.abc import Sequence
from typing import Literal

import numpy as np

Phase = Literal["open", "contact", "hold", "slip", "lost"]
_HELD_N = 4  # touched frames in a row
_EMPTY_N = 2  # empty frames in a row: lost
_DROP = 0.6  # empty: touched below 1 and below this share of what it was of late; a light touch may tremble
_REMEMBERED_N = 30


class GraspPhases:
    """Follows one finger or several, from how strongly each is touched (`OpenGel.touch`) and whether it slips."""

    def __init__(self, phase: Phase = "open") -> None:
        self.phase: Phase = phase
        self._touched_n = 0
        self._empty_n = 0
        self._held: list[deque[float]] = []

    def update(self, touches: Sequence[float | None], *, slips: bool) -> Phase:
        """The phase after a frame; ``touches`` of each finger, None where it is not seen and decides nothing."""
        if len(self._held) != len(touches):
            self._held = [deque(maxlen=_REMEMBERED_N) for _ in touches]
        if all(self._empty(touch, held) for touch, held in zip(touches, self._held, strict=True)):
            self._emptied()
        elif any(touch is not None and touch >= 1 for touch in touches):
            self._touched(touches, slips=slips)
        return self.phase

    def _empty(self, touch: float | None, held: deque[float]) -> bool:
        if touch is None:
            return False
        return touch < 1 and (len(held) == 0 or touch < _DROP * float(np.median(held)))

    def _emptied(self) -> None:
        self._empty_n, self._touched_n = self._empty_n + 1, 0
        if self.phase in {"hold", "slip"} and self._empty_n >= _EMPTY_N:
            self.phase = "lost"
        elif self.phase == "contact":
            self.phase = "open"

    def _touched(self, touches: Sequence[float | None], *, slips: bool) -> None:
        self._touched_n, self._empty_n = self._touched_n + 1, 0
        if self.phase in {"open", "lost"}:
            self.phase = "contact"
            for held in self._held:
                held.clear()
        elif self.phase == "contact" and self._touched_n >= _HELD_N:
            self.phase, slips = "hold", False  # what moved while the fingers closed
        for touch, held in zip(touches, self._held, strict=True):
            if touch is not None and touch >= 1:
                held.append(touch)
        if self.phase == "hold" and slips:
            self.phase = "slip"
        elif self.phase == "slip" and not slips and self._touched_n % _HELD_N == 0:
            self.phase = "hold"


class Grasp:
    """The phases of a grasp, ``whole``, and of each of its ``fingers``."""

    def __init__(self, fingers_n: int, phase: Phase = "open") -> None:
        self.whole = GraspPhases(phase)
        self.fingers = [GraspPhases(phase) for _ in range(fingers_n)]

    def update(self, touches: Sequence[float | None], slips: Sequence[bool], *, slides: bool | None = None) -> Phase:
        """The phase of the grasp after a frame of each finger; it ``slides`` where any slips, unless that is told."""
        for finger, touch, slip in zip(self.fingers, touches, slips, strict=True):
            finger.update([touch], slips=slip)
        return self.whole.update(touches, slips=any(slips) if slides is None else slides)
