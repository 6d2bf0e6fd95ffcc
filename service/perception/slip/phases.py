"""The phases of a grasp: open, contact, hold, slip, lost or released; of a finger alone, and of all fingers together.

A grasp exists while at least one finger is touched, so one finger that loses contact for a while is no loss. It has
ended once all fingers are empty in two consecutive frames: released if something else bore the object before
(`Support`), otherwise lost. Without loads, as in a live session, it is always lost.
"""

from collections import deque
from collections.abc import Sequence
from typing import Literal

import numpy as np

from service.perception.slip.rigid import Float64
from service.perception.slip.support import Support

Phase = Literal["open", "contact", "hold", "slip", "lost", "released"]
ENDED: frozenset[Phase] = frozenset({"lost", "released"})
_HELD_N = 4  # consecutive touched frames
EMPTY_N = 2  # consecutive empty frames: ended
_DROP = 0.6  # empty: touch below 1 and below this share of its recent value; a light touch may fluctuate
_REMEMBERED_N = 30
_BLIND_N = 8  # consecutive frames; a finger that is not visible for as long has no say in whether the others are empty

Loads = Sequence[Float64 | None]


class GraspPhases:
    """Follows one finger or several, from the strength of each touch (`OpenGel.touch`) and from slip."""

    def __init__(self, phase: Phase = "open") -> None:
        self.phase: Phase = phase
        self._touched_n = 0
        self._empty_n = 0
        self._held: list[deque[float]] = []
        self._unseen_n: list[int] = []
        self._support = Support()

    @property
    def borne(self) -> bool:
        """Whether the object is held, but borne by something other than the fingers."""
        return self.phase in {"hold", "slip"} and self._support.borne

    def update(self, touches: Sequence[float | None], *, slips: bool, loads: Loads = ()) -> Phase:
        """The phase after a frame; ``touches`` of each finger, None where it is not visible and has no say.

        ``loads``: each finger's `OpenGel.load`. While something else bears the object, its motion is no slip.
        """
        if len(self._held) != len(touches):
            self._held = [deque(maxlen=_REMEMBERED_N) for _ in touches]
            self._unseen_n = [0] * len(touches)
        self._unseen_n = [0 if touch is not None else n + 1 for touch, n in zip(touches, self._unseen_n, strict=True)]
        asked = [k for k, n in enumerate(self._unseen_n) if n < _BLIND_N] or range(len(touches))
        if all(self._empty(touches[k], self._held[k]) for k in asked):
            self._emptied()
            return self.phase
        if self.phase in {"hold", "slip"}:
            self._support.update(loads, sliding=self.phase == "slip")
        if any(touch is not None and touch >= 1 for touch in touches):
            self._touched(touches, slips=slips and not self._support.borne)
        return self.phase

    def _empty(self, touch: float | None, held: deque[float]) -> bool:
        if touch is None:
            return False
        return touch < 1 and (len(held) == 0 or touch < _DROP * float(np.median(held)))

    def _emptied(self) -> None:
        self._empty_n, self._touched_n = self._empty_n + 1, 0
        if self.phase in {"hold", "slip"} and self._empty_n >= EMPTY_N:
            self.phase = "released" if self._support.borne else "lost"
        elif self.phase == "contact":
            self.phase = "open"

    def _touched(self, touches: Sequence[float | None], *, slips: bool) -> None:
        self._touched_n, self._empty_n = self._touched_n + 1, 0
        if self.phase == "open" or self.phase in ENDED:
            self.phase, self._support = "contact", Support()
            for held in self._held:
                held.clear()
        elif self.phase == "contact" and self._touched_n >= _HELD_N:
            self.phase, slips = "hold", False  # motion while the fingers closed
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

    def update(
        self,
        touches: Sequence[float | None],
        slips: Sequence[bool],
        *,
        slides: bool | None = None,
        loads: Loads | None = None,
    ) -> Phase:
        """The phase of the grasp after a frame of each finger; ``slides`` replaces the default: any finger slips."""
        loads = [None] * len(touches) if loads is None else loads
        for finger, touch, slip, load in zip(self.fingers, touches, slips, loads, strict=True):
            finger.update([touch], slips=slip, loads=[load])
        return self.whole.update(touches, slips=any(slips) if slides is None else slides, loads=loads)
