"""Whether the object reached full depth with the fingers: the push left on the gels shows what depth alone cannot.

An object that stands on a block while the fingers descend slides up between them. If its whole patch slides at once, no
marker leaves the rigid motion, and below the push that separates a stalled patch from a slow one (see
`SlipSettings.stall_pitch`) there is no slip message. By Coulomb's law a sliding grasp carries the full friction force,
on both pads, as long as it slides. An object in its gap hangs free, or is carried by the gap's walls. An object jammed
there, tilted, leans on one pad and turns about the other.

The weaker finger's push is therefore compared with the strongest push of this grasp in the blocked attempts. Without a
blocked attempt, only the noise of the markers may remain: the force that a grasp can bear differs by ten between cells.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from service.contract import FINGERS
from service.perception.observation import PairObservation
from service.perception.slip.open_gel import WEIGHT_PITCH

HELD_SHARE = 0.03  # share of the grasp's capacity: most jams carried 0.04 and more, sliding 0.74, hanging free 0.0001
NOISE_PITCH = 0.008  # no smaller push counts: the common error of all of a finger's markers
LASTING = 1 / 3  # share of the descent's time: a slide from the tops lasts 0.7, a push from a floor 0.2
GLITCHES = 0.1  # share of the frames in that time that may show less
VALID_SHARE = 0.5  # share of a finger's markers


class Push(NamedTuple):
    """Push of the object on the gels, upwards since the reference, in marker pitches; NaN if unknown.

    ``moved_pitch``: motion of the markers in any direction, root mean square.
    """

    captured_ns: int
    weaker_pitch: float
    mean_pitch: float
    moved_pitch: float = math.nan


@dataclass(frozen=True, slots=True)
class SeatingEvidence:
    """The push on the weaker finger at full depth, and the push that implies a slide, in marker pitches.

    ``blocked_pitch`` is the strongest push of the blocked attempts, 0 without one.
    """

    push_pitch: float
    blocked_pitch: float

    @property
    def bound_pitch(self) -> float:
        """An object in its gap leaves less than this."""
        return max(NOISE_PITCH, HELD_SHARE * self.blocked_pitch)

    @property
    def seated(self) -> bool:
        """Whether the object counts as inserted; never for a non-finite number."""
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
    """The push in a pair. Up is -v for both fingers; rotations of the object in the plane of the gels cancel.

    NaN if a finger gives no new evidence, another grid, too few markers, or non-finite numbers.
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


def stood_pitch(reference: PairObservation | None) -> float:
    """The push on the weaker finger at arming, upwards since the gels were open, in pitches; NaN if unknown.

    It is in every later pair, too, so the pushes since the reference do not show it: gels that slid before carry no
    more as they slide on.
    """
    weights = [finger.weight for finger in reference.fingers] if reference else []
    known = [weight for weight in weights if weight is not None]
    return -max(known) * WEIGHT_PITCH if len(known) == len(FINGERS) else math.nan


def strongest_push(pushes: Sequence[Push]) -> float:
    """The strongest push among ``pushes``, in pitches; 0 if none is finite."""
    return max([0.0, *(push.mean_pitch for push in pushes if math.isfinite(push.mean_pitch))])


def seating_evidence(pushes: Sequence[Push], begin_ns: int, blocked_pitch: float) -> SeatingEvidence:
    """The evidence at full depth; ``pushes`` are those of the descent that began at ``begin_ns``, oldest first.

    Only the lasting push of the last part of the descent counts. NaN if there is none, or not in the newest pair.
    """
    if not pushes or not math.isfinite(pushes[-1].weaker_pitch):
        return SeatingEvidence(math.nan, blocked_pitch)
    since_ns = pushes[-1].captured_ns - LASTING * max(0, pushes[-1].captured_ns - begin_ns)
    late = [push.weaker_pitch for push in pushes if push.captured_ns >= since_ns and math.isfinite(push.weaker_pitch)]
    return SeatingEvidence(float(np.quantile(late, GLITCHES)), blocked_pitch)
