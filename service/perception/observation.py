"""The result of perception for one frame of one finger, and its interface."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from service.contract import Finger, TactileFrame
from service.perception.markers.field import MarkerField
from service.perception.slip.detector import SlipState
from service.perception.slip.imprint import ImprintChange


@dataclass(frozen=True, slots=True)
class Observation:
    """One frame after perception.

    - ``image``: the rectified frame uint8 [H, W, 3]. ``field``: the markers.
    - ``slip``: the slip state since the last rearm.
    - ``onset_ns``: capture stamp of the first frame that shows the object's motion, once certain.
    - ``cost_ms``: time by part: rectification, markers, slip (with open gel and liveness) and imprint.
    - ``bulge``: displacement of the markers over an untouched gel's limit; below 1 untouched, None: unknown.
    - ``touch``: the same for the whole picture, if the open gel's was learnt; the phases of a grasp follow it.
    - ``weight``: downward displacement of the markers; from 1 on something's weight.
    - ``certain_ns``: capture stamp of the newest frame that is certainly no copy of an earlier one: this one's, or
      that of the frame before where only the next one will tell; None: this one's.
    - ``imprint``: change of the imprint between the markers, if requested.
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
    certain_ns: int | None = None

    @property
    def felt(self) -> float | None:
        """The touch that the markers or the picture show, whichever is stronger, from 1 on certain; None: unknown."""
        return None if self.bulge is None else max(self.bulge, self.touch or 0.0)

    @property
    def feels(self) -> bool:
        """Whether the gel is certainly touched."""
        return self.felt is not None and self.felt >= 1.0

    @property
    def informative(self) -> bool:
        """Whether this frame says anything about slip: its markers are new and were compared with the reference."""
        return self.field.usable and self.slip.state not in {"unknown", "lost"}


class FingerWatch(Protocol):
    """Perception of one finger; not thread safe.

    ``gel_distance``: difference between its open gel and the calibrated one, 0 to 2; None if unknown.
    """

    gel_distance: float | None

    def rearm(self) -> None:
        """The next frame shows the held object at rest: it becomes the reference of slip and onset."""

    def learn_open(self, frame: TactileFrame) -> str:
        """Take the frame as the open gel, touched by nothing; returns why that cannot be, or ""."""

    def explain(self, frame: TactileFrame) -> str:
        """Why a frame that was refused as the open gel may not show it."""

    def forget_open(self) -> None:
        """What was learnt as the open gel was none."""

    def observe(self, frame: TactileFrame) -> Observation:
        """Perceive a frame; raise ContractError if its size is neither raw nor rectified."""


@dataclass(frozen=True, slots=True)
class PairObservation:
    """Both fingers of one instant after perception."""

    left: Observation
    right: Observation

    @property
    def looks_open(self) -> bool:
        """Whether both gels look untouched, apart from something's weight."""
        return all(finger.felt is not None and not finger.feels for finger in self.fingers)

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

    def unlike_grids(self) -> str:
        """The fault if the fingers' gels carry different grids, or "": no network was trained on such a pair."""
        (rows, columns), (right_rows, right_columns) = (finger.field.valid.shape for finger in self.fingers)
        if (rows, columns) == (right_rows, right_columns):
            return ""
        left, right = f"left {columns} x {rows} markers", f"right {right_columns} x {right_rows}"
        return f"the fingers show different grids: {left}, {right}"

    def pixels(self) -> NDArray[np.uint8]:
        """Rectified uint8 [2, H, W, 3], left first, as input of the networks."""
        return np.stack([self.left.image, self.right.image])

    def markers_px(self) -> NDArray[np.float32]:
        """Positions of both fingers' markers, float32 [2, rows, columns, 2]; NaN where they were not found."""
        fields = self.left.field, self.right.field
        places = [np.where(one.valid[..., None], one.rest_px + one.displacement_px, np.nan) for one in fields]
        return np.stack(places).astype(np.float32)


def nothing_held(both: PairObservation) -> str:
    """Why the hand counts as empty, or "": both gels look as if nothing touches them.

    One finger alone may look so, under a flat object in a light grip. Stiff gels may show only the object's weight.
    """
    weighed = all((finger.weight or 0.0) >= 1.0 for finger in both.fingers)
    return "both gels look as they do when nothing touches them" if both.looks_open and not weighed else ""
