"""Recorded frame pairs as marker fields: what a network that reads markers is shown of a stored decision."""

import numpy as np
from numpy.typing import NDArray

from service.perception.field import marker_array
from service.perception.markers import MarkerTracker

FRAME_PERIOD_NS = 33_333_333


def track_pairs(frames: NDArray[np.uint8], period_ns: int = FRAME_PERIOD_NS) -> NDArray[np.float32]:
    """Marker fields float32 [n, 2, rows, columns, 3] of rectified frames uint8 [n, 2, H, W, 3], tracked from the first.

    Raises ValueError if the two fingers show grids of different size, or one of them none.
    """
    trackers = MarkerTracker(), MarkerTracker()
    fields = [
        [marker_array(tracker.update(image, index * period_ns)) for tracker, image in zip(trackers, pair, strict=True)]
        for index, pair in enumerate(frames)
    ]
    shapes = {field.shape for pair in fields for field in pair}
    if len(shapes) != 1 or not next(iter(shapes))[0]:
        raise ValueError(f"the fingers show marker grids of {sorted(shapes)}, expected one size for both")
    return np.stack([np.stack(pair) for pair in fields])
