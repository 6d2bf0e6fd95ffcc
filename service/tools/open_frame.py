"""Finds the open gel in a recording that does not mark its open frames.

Gels count as open only where the grids of all of them look regular (`regular`). Of such frames, the first ones are used
that are about as regular and as smooth between their markers as any. A recording in which an object is held from the
first frame to the last has none; its least disturbed frame can still serve as the zero of the loads.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from service.perception.markers.field import MarkerField
from service.perception.markers.regular import irregular_pitch

_BUFFERED_N = 8  # first frames, which may show an earlier grasp, and whose exposure has not settled
_TINTED = 0.15  # a picture whose colour deviates from the usual one by this share has another exposure
_MARKER = np.ones((5, 5), np.uint8)  # shrunk px; closes dark markers
_AROUND_PX = (9, 9)
_ROUGH = 0.06  # share of the picture; the place of the imprint
_CALM_N = 5  # frames
_REGULAR_PITCH = 0.016  # RMS off the print; no present grasp leaves open gels beyond it, few held ones are below it
_AS_OPEN = 0.15  # difference of the logarithm of all gels' joint disturbance
_FIRST_N = 12  # frames after the first that looks open, of which the most open is used


Pictures = Sequence[NDArray[np.uint8]]


class Rest(NamedTuple):
    """The frame in which all gels are least disturbed, and whether they are open in it."""

    frame: int
    is_open: bool


def rest(pictures: Sequence[Pictures], fields: Sequence[Sequence[MarkerField]]) -> Rest | None:
    """The gels at rest; None if there is no frame to compare with others.

    A frame that repeats the one before, as a recorder of a fixed rate adds them, is as much disturbed.

    ``pictures`` of each finger: shrunk, uint8 [h, w, channels]; ``fields``: the markers in the same frames.
    """
    frames_n = min(len(one) for one in pictures)
    off = np.array([_irregular(one[:frames_n]) for one in fields])
    rough = np.array([_roughness(one[:frames_n]) for one in pictures])
    for disturbance in (off, rough):
        disturbance[:, : min(_BUFFERED_N, frames_n - 1)] = np.inf
    disturbed = _calm(_beyond_least(off) + _beyond_least(rough))
    if not np.isfinite(disturbed.min()):
        return None
    resting = disturbed <= disturbed.min() + _AS_OPEN
    looks_open = resting & (off.max(0) <= _REGULAR_PITCH)
    is_open = bool(looks_open.any())
    among = looks_open if is_open else resting
    first = int(among.argmax())
    return Rest(first + int(np.where(among, disturbed, np.inf)[first : first + _FIRST_N].argmin()), is_open)


def _irregular(fields: Sequence[MarkerField]) -> list[float]:
    off: list[float] = []
    for field in fields:
        off.append(off[-1] if off and field.status == "duplicate" else irregular_pitch(field))
    return off


def _beyond_least(disturbance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sum over the fingers [fingers, frames] of the log ratio of the disturbance to its minimum."""
    least = np.array(
        [np.percentile(one[np.isfinite(one)], 2) if np.isfinite(one).any() else np.inf for one in disturbance]
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        logs = np.log(disturbance / np.maximum(least, 1e-9)[:, None])
    return np.asarray(np.where(np.isfinite(logs), logs, np.inf).sum(0))


def _calm(disturbance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean over the frames around each; infinite where any of them is."""
    padded = np.pad(disturbance, _CALM_N // 2, "edge")
    return np.asarray(np.lib.stride_tricks.sliding_window_view(padded, _CALM_N).mean(1))


def _roughness(pictures: Pictures) -> NDArray[np.float64]:
    """Roughness of the gel between its markers, frame by frame; infinite under another exposure."""
    tint = np.array([np.median(picture.reshape(-1, picture.shape[-1]), 0) for picture in pictures])
    usual = np.abs(tint / np.maximum(np.median(tint, 0), 1.0) - 1).max(1) < _TINTED
    return np.where(usual, np.array([_rough(picture) for picture in pictures]), np.inf)


def _rough(picture: NDArray[np.uint8]) -> float:
    closed = cv2.morphologyEx(picture, cv2.MORPH_CLOSE, _MARKER).astype(np.float32)
    edges = np.abs(closed - cv2.blur(closed, _AROUND_PX)).reshape(*picture.shape[:2], -1).max(-1)
    inner = edges[4:-4, 4:-4].ravel()
    count = max(1, int(_ROUGH * inner.size))
    return float(np.partition(inner, -count)[-count:].mean())
