"""Whether an arm at full depth has taken its object along: the push that the gels still carry tells what depth cannot.

An object that stands on a block while the fingers go down slides up between them. Where its whole patch lets go at
once no marker leaves the rigid motion, and below the push at which a stalled patch is told from a slow one (see
`slip_state.SlipSettings.stall_pitch`) there is no slip message. But by Coulomb's law a grasp that slides carries all
that its friction bears, on both pads and for as long as it slides. An object in its gap is carried by the gap's walls
at most; one that jams there, tilted, leans on one pad and turns about the other. So the weaker finger's push is held
against the strongest push that this grasp was seen to bear, in the attempts that were blocked.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from service.perception.observation import PairObservation

HELD_SHARE = 0.5  # of what the grasp bears: sliding it carried 0.94 and more, in a gap up to 0.05, jammed up to 0.28
UNTRIED_PITCH = 0.4  # taken for that before any attempt was blocked: half of what a clean gel and a usual grip bear
LEAST_PITCH = 0.1  # no smaller push counts: rubbing on the gap's walls leaves 0.015
LASTING = 1 / 3  # of the descent's time: from the blocks' tops on it slides for 0.7; a floor pushes for the last 0.2
GLITCHES = 0.1  # of the frames in that time, which may show less
SEEN_SHARE = 0.5  # of a finger's markers


class Push(NamedTuple):
    """How far the object has pushed the gels up since the reference, in shares of the marker pitch; NaN: not seen."""

    captured_ns: int
    weaker_pitch: float
    mean_pitch: float


@dataclass(frozen=True, slots=True)
class Look:
    """What the weaker finger carries at full depth, and from where on an object is taken to have slid, in pitches.

    ``bears_pitch`` is the strongest push of the attempts that were blocked, 0 where there was none.
    """

    push_pitch: float
    bears_pitch: float

    @property
    def bound_pitch(self) -> float:
        """An object in its gap leaves less than this."""
        return max(LEAST_PITCH, HELD_SHARE * (self.bears_pitch or UNTRIED_PITCH))

    @property
    def seated(self) -> bool:
        """Whether the object may be claimed as inserted; never on a number that is none."""
        return math.isfinite(self.push_pitch) and self.push_pitch < self.bound_pitch

    def __str__(self) -> str:
        """One line for the operator."""
        bears = f", {self.push_pitch / self.bears_pitch:.0%} of the strongest they bore" if self.bears_pitch else ""
        return (
            f"reached full depth, but the gels still carry a push of {self.push_pitch:.2f} marker pitches{bears}"
            f" (in a gap: below {self.bound_pitch:.2f}); the object probably slid up in the hand; not claimed"
        )


def push_of(both: PairObservation, reference: PairObservation) -> Push:
    """The push that a pair shows. Up is -v for both fingers; turns of the object in the plane of the gels cancel.

    NaN where a finger cannot tell: no new evidence, another grid, too few markers, or numbers that are none.
    """
    found = []
    for now, then in zip(both.fingers, reference.fingers, strict=True):
        may = now.field.valid & then.field.valid if now.field.valid.shape == then.field.valid.shape else np.zeros(0)
        if not now.field.usable or not may.sum() > SEEN_SHARE * may.size:
            return Push(both.captured_ns, math.nan, math.nan)
        carried = now.field.displacement_px[may, 1] - then.field.displacement_px[may, 1]
        found.append(-float(np.mean(carried, dtype=np.float64)) / now.field.pitch_px)
    mean = 0.5 * (found[0] + found[1])
    return Push(both.captured_ns, min(found) if math.isfinite(mean) else math.nan, mean)


def borne(pushes: Sequence[Push]) -> float:
    """The strongest push among ``pushes``, in pitches; 0 where none was seen."""
    return max([0.0, *(push.mean_pitch for push in pushes if math.isfinite(push.mean_pitch))])


def look(pushes: Sequence[Push], begin_ns: int, bears_pitch: float) -> Look:
    """The look at full depth; ``pushes`` are those of the descent that began at ``begin_ns``, oldest first.

    What counts is the push that lasts, that of the time's last part. NaN where none was seen, or not in the newest.
    """
    if not pushes or not math.isfinite(pushes[-1].weaker_pitch):
        return Look(math.nan, bears_pitch)
    since_ns = pushes[-1].captured_ns - LASTING * max(0, pushes[-1].captured_ns - begin_ns)
    late = [push.weaker_pitch for push in pushes if push.captured_ns >= since_ns and math.isfinite(push.weaker_pitch)]
    return Look(float(np.quantile(late, GLITCHES)), bears_pitch)
