"""The result of perception for one frame of one finger, and its interface."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from service.contract import Finger, FramePair, TactileFrame
from service.perception.markers.field import MarkerField
from service.perception.slip.detector import SlipState
from service.perception.slip.imprint import ImprintChange

WEIGHED_SHARE = 0.5  # of the bulge that a gel showed under an object whose weight alone was felt: with less it is lost


@dataclass(frozen=True, slots=True)
class Observation:
    """One frame after perception.

    ``image`` is the rectified frame uint8 [H, W, 3]; ``field`` the markers; ``slip`` the slip state since the last
    rearm; ``onset_ns`` the capture stamp of the first frame that shows the object's motion, once that is certain;
    ``cost_ms`` the time of rectification, tracking and slip detection. ``bulge``: how far the markers are from where
    they lie in an untouched gel, in shares of what such a gel may show; below 1 nothing touches it, None: unknown.
    ``touch``: the same of the whole picture, where one of the open gel was learnt; what phases of a grasp follow.
    ``weight``: how far the markers hang down, from 1 on something's weight.
    ``imprint``: what the imprint between the markers did, where it is asked for.
    """

    finger: Finger
    seq: int
    captured_ns: int
    image: NDArray[np.uint8]
    field: MarkerField
    slip: SlipState
    onset_ns: int | None
    cost_ms: dict[str, float]
    bulge: float | None = None
    touch: float | None = None
    imprint: ImprintChange | None = None
    weight: float | None = None

    @property
    def informative(self) -> bool:
        """Whether this frame says anything about slip: its markers were found anew and compared with the reference."""
        return self.field.usable and self.slip.state not in {"unknown", "lost"}


class FingerWatch(Protocol):
    """Perception of one finger; not thread safe.

    ``gel_distance``: how unlike its open gel is to the one that was calibrated, 0 to 2; None if that is not known.
    """

    gel_distance: float | None

    def rearm(self) -> None:
        """The next frame shows the held object at rest: it becomes the reference of slip and onset."""

    def learn_open(self, frame: TactileFrame) -> str:
        """Take the frame as that of a gel that nothing touches; why that cannot be, or nothing."""

    def observe(self, frame: TactileFrame) -> Observation:
        """Perceive a frame; raise ContractError if its size is neither raw nor rectified."""


@dataclass(frozen=True, slots=True)
class PairObservation:
    """Both fingers of one instant after perception."""

    left: Observation
    right: Observation

    @property
    def looks_open(self) -> bool:
        """Whether both gels look as they do where nothing touches them, but for something's weight."""
        return all(f.bulge is not None and max(f.bulge, f.touch or 0.0) < 1.0 for f in self.fingers)

    @property
    def fingers(self) -> tuple[Observation, Observation]:
        return self.left, self.right

    @property
    def seq(self) -> int:
        """Sequence number of the pair: that of the left finger."""
        return self.left.seq

    @property
    def captured_ns(self) -> int:
        """Capture time of the later of the two frames."""
        return max(self.left.captured_ns, self.right.captured_ns)

    def pixels(self) -> NDArray[np.uint8]:
        """Rectified uint8 [2, H, W, 3], left first, as the networks take them."""
        return np.stack([self.left.image, self.right.image])

    def markers_px(self) -> NDArray[np.float32]:
        """Where both fingers' markers are, float32 [2, rows, columns, 2]; NaN where they were not found."""
        fields = self.left.field, self.right.field
        places = [np.where(one.valid[..., None], one.rest_px + one.displacement_px, np.nan) for one in fields]
        return np.stack(places).astype(np.float32)


def belongs(observation: Observation, pair: FramePair) -> bool:
    """Whether an observation is of this pair's frame of the same finger."""
    frame = pair.left if observation.finger == "left" else pair.right
    return observation.seq == frame.seq and observation.captured_ns == frame.captured_ns
