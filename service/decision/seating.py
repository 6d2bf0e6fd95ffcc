"""Whether the object went along to full depth: the push that the gels still carry shows what depth alone cannot.

An object that stands on a block while the fingers go down slides up between them. If its whole patch lets go at once,
no marker leaves the rigid motion, and below the push that separates a stalled patch from a slow one (see
`SlipSettings.stall_pitch`) there is no slip message. By Coulomb's law a grasp that slides carries all that its friction
bears, on both pads and for as long as it slides. An object in its gap hangs free, or is carried by the gap's walls.
One that jams there, tilted, leans on one pad and turns about the other. So the weaker finger's push is compared with
the strongest push of this grasp in the attempts that were blocked. Where none was, nothing but the noise of the
markers may be left: how much a grasp can bear differs by ten between cells.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from service.perception.observation import PairObservation

HELD_SHARE = 0.03  # of what the grasp bears: most jams carried 0.04 and more, sliding 0.74, hanging free 0.0001
NOISE_PITCH = 0.008  # no smaller push counts: what a finger's markers, all of them together, may be off
LASTING = 1 / 3  # of the descent's time: from the blocks' tops on it slides for 0.7; a floor pushes for the last 0.2
GLITCHES = 0.1  # of the frames in that time, which may show less
VALID_SHARE = 0.5  # of a finger's markers


class Push(NamedTuple):
    """How far the object has pushed the gels up since the reference, in marker pitches; NaN where it is not known.

    ``moved_pitch``: how far the markers moved in any direction, root mean square.
    """

    captured_ns: int
    weaker_pitch: float
    mean_pitch: float
    moved_pitch: float = math.nan


@dataclass(frozen=True, slots=True)
class SeatingEvidence:
    """The push on the weaker finger at full depth, and the push from which on the object has slid, in marker pitches.

    ``blocked_pitch`` is the strongest push of the attempts that were blocked, 0 where there was none.
    """

    push_pitch: float
    blocked_pitch: float

    @property
    def bound_pitch(self) -> float:
        """An object in its gap leaves less than this."""
        return max(NOISE_PITCH, HELD_SHARE * self.blocked_pitch)

    @property
    def seated(self) -> bool:
        """Whether the object counts as inserted; a number that is not finite never does."""
        return math.isfinite(self.push_pitch) and self.push_pitch < self.bound_pitch

    def __str__(self) -> str:
        of_blocked = (
            f", {self.push_pitch / self.blocked_pitch:.0%} of the strongest they bore" if self.blocked_pitch else ""
        )
        return (
            f"the gels still carry a push of {self.push_pitch:.3f} marker pitches{of_blocked} (in a gap: below"
            f" {self.bound_pitch:.3f}): the object slid up in the hand, or is jammed"
        )


def push_of(both: PairObservation, reference: PairObservation) -> Push:
    """The push that a pair shows. Up is -v for both fingers; rotations of the object in the plane of the gels cancel.

    NaN if a finger gives no new evidence, another grid, too few markers, or numbers that are not finite.
    """
    means, squares = [], []
    for now, then in zip(both.fingers, reference.fingers, strict=True):
        may = now.field.valid & then.field.valid if now.field.valid.shape == then.field.valid.shape else np.zeros(0)
        if not now.field.usable or not may.sum() > VALID_SHARE * may.size:
            return Push(both.captured_ns, math.nan, math.nan)
        carried = now.field.displacement_px[may] - then.field.displacement_px[may]
        means.append(-float(np.mean(carried[:, 1], dtype=np.float64)) / now.field.pitch_px)
        squares.append(float(np.square(carried, dtype=np.float64).sum(-1).mean()) / now.field.pitch_px**2)
    mean = 0.5 * (means[0] + means[1])
    weaker = min(means) if math.isfinite(mean) else math.nan
    return Push(both.captured_ns, weaker, mean, math.sqrt(0.5 * (squares[0] + squares[1])))


def strongest_push(pushes: Sequence[Push]) -> float:
    """The strongest push among ``pushes``, in pitches; 0 if none is finite."""
    return max([0.0, *(push.mean_pitch for push in pushes if math.isfinite(push.mean_pitch))])


def seating_evidence(pushes: Sequence[Push], begin_ns: int, blocked_pitch: float) -> SeatingEvidence:
    """The evidence at full depth; ``pushes`` are those of the descent that began at ``begin_ns``, oldest first.

    Only the lasting push counts, that of the last part of the descent. NaN if there is none, or not in the newest pair.
    """
    if not pushes or not math.isfinite(pushes[-1].weaker_pitch):
        return SeatingEvidence(math.nan, blocked_pitch)
    since_ns = pushes[-1].captured_ns - LASTING * max(0, pushes[-1].captured_ns - begin_ns)
    late = [push.weaker_pitch for push in pushes if push.captured_ns >= since_ns and math.isfinite(push.weaker_pitch)]
    return SeatingEvidence(float(np.quantile(late, GLITCHES)), blocked_pitch)
