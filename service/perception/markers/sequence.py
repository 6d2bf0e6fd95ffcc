"""Recorded frame pairs as marker fields: the input of a network that reads markers for a stored decision."""

import numpy as np
from numpy.typing import NDArray

from service.contract import ContractError, MarkerSpec
from service.perception.markers.field import marker_array
from service.perception.markers.tracker import MarkerTracker


def track_pairs(frames: NDArray[np.uint8], lattice: MarkerSpec, fps: float) -> NDArray[np.float32]:
    """Marker fields float32 [n, 2, rows, columns, 3] of rectified frames uint8 [n, 2, H, W, 3], tracked from the first.

    Raises ContractError where a finger shows no such grid.
    """
    period_ns, trackers = round(1e9 / fps), (MarkerTracker(), MarkerTracker())
    fields = np.zeros((len(frames), 2, lattice.rows, lattice.columns, 3), np.float32)
    for index, pair in enumerate(frames):
        for finger, (tracker, image) in enumerate(zip(trackers, pair, strict=True)):
            try:
                fields[index, finger] = marker_array(tracker.update(image, index * period_ns), lattice)
            except ValueError as error:
                raise ContractError(f"frame {index} of a stored decision: {error}") from error
    return fields
