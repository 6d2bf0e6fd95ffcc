"""Recorded frame pairs as marker fields: the input of a network that reads markers for a stored decision."""

import numpy as np
from numpy.typing import NDArray

from service.contract import MarkerSpec
from service.perception.markers.field import marker_array
from service.perception.markers.tracker import MarkerTracker


def track_pairs(frames: NDArray[np.uint8], lattice: MarkerSpec, fps: float) -> NDArray[np.float32]:
    """Marker fields float32 [n, 2, rows, columns, 3] of rectified frames uint8 [n, 2, H, W, 3], tracked from the first.

    Raises ValueError where a finger shows no such grid.
    """
    period_ns, trackers = round(1e9 / fps), (MarkerTracker(), MarkerTracker())
    return np.stack(
        [
            np.stack(
                [
                    marker_array(tracker.update(image, index * period_ns), lattice)
                    for tracker, image in zip(trackers, pair, strict=True)
                ]
            )
            for index, pair in enumerate(frames)
        ]
    )
