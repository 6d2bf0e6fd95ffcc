"""The phases of a grasp: open, contact, hold, slip, lost; of a finger alone, and of all fingers together.

A grasp is what at least one finger still touches, so one finger that lets go for a while is no loss. It is lost once
all fingers are empty in two frames that follow each other.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

Phase = Literal["open", "contact", "hold", "slip", "lost"]


@dataclass(frozen=True, slots=True)
class PhaseSettings:
    """Held after ``held_n`` touched frames in a row, lost after ``empty_n`` empty ones.

    Empty: touched below 1, and below ``drop`` of what it was of late, so that a light touch that trembles is no loss.
    """

    held_n: int = 4
    empty_n: int = 2
    drop: float = 0.6
    remembered_n: int = 30


class GraspPhases:
    """Follows one finger or several, from how strongly each is touched (`OpenGel.touch`) and whether it slips."""

    def __init__(self, settings: PhaseSettings | None = None, phase: Phase = "open") -> None:
        self.settings = settings or PhaseSettings()
        self.phase: Phase = phase
        self._touched_n = 0
        self._empty_n = 0
        self._held: list[deque[float]] = []

    def update(self, touches: Sequence[float | None], *, slips: bool) -> Phase:
        """The phase after a frame; ``touches`` of each finger, None where it is not seen and decides nothing."""
        if len(self._held) != len(touches):
            self._held = [deque(maxlen=self.settings.remembered_n) for _ in touches]
        if all(self._empty(touch, held) for touch, held in zip(touches, self._held, strict=True)):
            self._emptied()
        elif any(touch is not None and touch >= 1 for touch in touches):
            self._touched(touches, slips=slips)
        return self.phase

    def _empty(self, touch: float | None, held: deque[float]) -> bool:
        if touch is None:
            return False
        return touch < 1 and (len(held) == 0 or touch < self.settings.drop * float(np.median(held)))

    def _emptied(self) -> None:
        self._empty_n, self._touched_n = self._empty_n + 1, 0
        if self.phase in {"hold", "slip"} and self._empty_n >= self.settings.empty_n:
            self.phase = "lost"
        elif self.phase == "contact":
            self.phase = "open"

    def _touched(self, touches: Sequence[float | None], *, slips: bool) -> None:
        self._touched_n, self._empty_n = self._touched_n + 1, 0
        if self.phase in {"open", "lost"}:
            self.phase = "contact"
            for held in self._held:
                held.clear()
        elif self.phase == "contact" and self._touched_n >= self.settings.held_n:
            self.phase, slips = "hold", False  # what moved while the fingers closed
        for touch, held in zip(touches, self._held, strict=True):
            if touch is not None and touch >= 1:
                held.append(touch)
        if self.phase == "hold" and slips:
            self.phase = "slip"
        elif self.phase == "slip" and not slips and self._touched_n % self.settings.held_n == 0:
            self.phase = "hold"


class Grasp:
    """The phases of a grasp, ``whole``, and of each of its ``fingers``."""

    def __init__(self, fingers_n: int, phase: Phase = "open") -> None:
        self.whole = GraspPhases(phase=phase)
        self.fingers = [GraspPhases(phase=phase) for _ in range(fingers_n)]

    def update(self, touches: Sequence[float | None], slips: Sequence[bool], *, slides: bool | None = None) -> Phase:
        """The phase of the grasp after a frame of each finger; it ``slides`` where any slips, unless that is told."""
        for finger, touch, slip in zip(self.fingers, touches, slips, strict=True):
            finger.update([touch], slips=slip)
        return self.whole.update(touches, slips=any(slips) if slides is None else slides)
