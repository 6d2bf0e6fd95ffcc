"""One finger's recording after perception, and which of its frames show anything new.

A recorder that writes at a fixed rate stores frames of a slower camera twice. What is counted in frames is counted in
those that are new.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from service.perception.markers.field import MarkerField
from service.perception.slip.imprint import ImprintChange
from service.perception.slip.open_gel import OpenGel
from service.perception.slip.rigid import Float64
from service.tools.open_frame import Rest

_UNSEEN = 0.5  # share of the frames in which a finger's markers may be invisible
_ALIKE = 4  # grey levels between the colour channels of a grey picture: codecs make up to 2


class Felt(NamedTuple):
    """`OpenGel.touch` and `OpenGel.load` of one frame."""

    touch: float | None
    load: Float64 | None


@dataclass(slots=True)
class FingerRun:
    """One finger's recording after perception, frame by frame; slip score and alarm come from its markers alone."""

    fields: list[MarkerField] = field(default_factory=list)
    pictures: list[NDArray[np.uint8]] = field(default_factory=list)
    scores: list[float] = field(default_factory=list)
    slips: list[bool] = field(default_factory=list)
    changes: list[ImprintChange | None] = field(default_factory=list)
    frames_n: int = 0
    missing_n: int = 0
    spent_s: float = 0.0

    def same_pictures(self, other: "FingerRun") -> bool:
        """Whether a second recording has the pictures of this one, up to the end of one: it is the same camera's."""
        return all(map(np.array_equal, self.pictures, other.pictures))

    @property
    def shows_gel(self) -> bool:
        """Whether the markers are seen in enough of the frames."""
        unseen_n = sum(markers.status in {"lost", "no_grid"} for markers in self.fields)
        return unseen_n <= _UNSEEN * len(self.fields)

    @property
    def is_grey(self) -> bool:
        """Whether the colour channels are equal in all pictures, but for a codec's rounding."""
        return all(int(np.ptp(picture, axis=-1).max()) <= _ALIKE for picture in self.pictures)

    def only(self, frames: Sequence[int]) -> "FingerRun":
        """The recording as if it had these frames alone."""
        return FingerRun(
            [self.fields[k] for k in frames],
            [self.pictures[k] for k in frames],
            [self.scores[k] for k in frames],
            [self.slips[k] for k in frames],
            [self.changes[k] for k in frames],
            self.frames_n,
            self.missing_n,
            self.spent_s,
        )

    def felt(self, still: Rest | None) -> list[Felt]:
        """What the gel feels in each frame, compared with the frame at rest.

        Unless it is open in that, it counts as touched wherever its markers are visible: an end cannot be shown then.
        A frame that repeats the one before feels the same.
        """
        touches: list[float | None] = [1.0 if markers.usable else None for markers in self.fields]
        if still is None:
            return [Felt(touch, None) for touch in touches]
        begun, gel = time.process_time(), OpenGel()
        gel.learn(self.fields[still.frame], self.pictures[still.frame].astype(np.float32))
        if still.is_open:
            touches = [
                gel.touch(markers, picture.astype(np.float32))
                for markers, picture in zip(self.fields, self.pictures, strict=True)
            ]
        felt: list[Felt] = []
        for touch, markers in zip(touches, self.fields, strict=True):
            repeats = markers.status == "duplicate" and felt
            felt.append(felt[-1] if repeats else Felt(touch, gel.load(markers)))
        self.spent_s += time.process_time() - begun
        return felt


def new_frames(fingers: Sequence[FingerRun]) -> list[int]:
    """The frames, up to the end of the shortest recording, in which at least one finger's is no repeated one."""
    pairs = zip(*(finger.fields for finger in fingers), strict=False)
    return [k for k, pair in enumerate(pairs) if any(markers.status != "duplicate" for markers in pair)]
