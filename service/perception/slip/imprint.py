"""The imprint between the markers: its motion over the gel, and its pressure.

The picture is sampled at fixed places between the markers, so it moves with the gel; any remaining change comes from
the object moving against the gel or from a change of pressure. The markers are left out, slow light is divided away.
"""

from collections import deque
from dataclasses import dataclass
from functools import reduce

import cv2
import numpy as np
from numpy.typing import NDArray

from service.perception.markers.field import FloatArray, MarkerField
from service.perception.markers.regular import irregular_pitch

_EVERY_NS = 100_000_000  # frames closer than this to the last one examined are skipped
_GAP_NS = 600_000_000  # after this time out of sight, the imprint is not compared with an earlier one
_LATER_N = 3  # frames over which the imprint is also compared
_SHRUNK_PITCH_PX = 20.0  # an image with a much larger pitch is shrunk first
_SAMPLES = 8  # per pitch, of small grids
_LARGE_N = 150  # markers, from which half as many samples suffice
_MARKER = 2.9 / 8  # pitch; radius of the excluded disc
_FINE, _SLOW, _AROUND = 1.0 / 8, 5.0 / 8, 9.0 / 8  # pitch
_DARK = 8.0  # grey
_LEAST = 1.0  # power of an imprint, (percent of the light)^2; smaller ones carry no information
_WHERE = 0.05  # share of the gel, which a sliding rim or pen changes
_STRONG = 0.1  # share of the gel from which the grip's strength is estimated
_LITTLE = 0.15  # percent; smaller changes of relief are ignored
_AROUND_EDGE = np.ones((3, 3), np.uint8)
_RIDGE = np.diag([0.05, 0.05, 0.05, 5.0])  # (percent of the light)^2; a fainter imprint does not move


@dataclass(frozen=True, slots=True)
class ImprintChange:
    """Change of one finger's imprint since the last examined frames.

    ``changed`` and ``changed_later`` 0 .. 2: share of the imprint that differs from one frame and three frames before,
    where it has changed most. ``let_go`` -1 .. 1: relief lost rather than gained within three frames. ``relief``: of
    the imprint, percent of the light. ``irregular_pitch``: deviation of the markers from a regular print.
    ``walked_pitch``: motion of the whole imprint over the gel since the last examined frame, right and down.
    """

    changed: float
    changed_later: float
    let_go: float
    relief: float
    irregular_pitch: float
    walked_pitch: tuple[float, float]


@dataclass(frozen=True, slots=True)
class _Look:
    imprint: FloatArray
    relief: FloatArray  # local, percent


class ImprintWatch:
    """Follows one finger's imprint; the last change stands where no new frame is examined."""

    def __init__(self) -> None:
        self._grid: _Grid | None = None
        self._looks: deque[_Look] = deque(maxlen=_LATER_N)
        self._won: deque[tuple[float, float]] = deque(maxlen=3)
        self._noise = np.inf  # difference of two frames of the stillest gel so far, (percent of the light)^2
        self._looked_ns: int | None = None
        self.last: ImprintChange | None = None

    def update(self, image: NDArray[np.uint8], field: MarkerField) -> ImprintChange | None:
        """Examine a rectified image, uint8 [h, w, 3], and its markers; None before two images."""
        since_ns = _GAP_NS if self._looked_ns is None else field.captured_ns - self._looked_ns
        if not field.usable or since_ns < _EVERY_NS:
            return self.last
        self._looked_ns = field.captured_ns
        if self._grid is None or self._grid.shape != field.valid.shape:
            self._grid, since_ns = _Grid(field.valid.shape, field.pitch_px, image.shape[2]), _GAP_NS
            self._noise = np.inf
        if since_ns >= _GAP_NS:
            self.last = None
            self._looks.clear()
            self._won.clear()
        look = self._grid.look(image, field)
        if self._looks:
            self.last = self._compare(look, field)
        self._looks.append(look)
        return self.last

    def _compare(self, now: _Look, field: MarkerField) -> ImprintChange:
        assert self._grid is not None
        before = self._looks[-1]
        moved = self._grid.power(now.imprint - before.imprint)
        self._noise = min(self._noise, _all_but(_WHERE, moved))
        gone = before.relief - now.relief
        self._won.append((float(np.maximum(gone, 0).mean()), float(np.maximum(-gone, 0).mean())))
        lost, won = np.sum(self._won, 0)
        later = self._looks[-_LATER_N] if len(self._looks) >= _LATER_N else before
        return ImprintChange(
            self._changed(before, now, moved),
            self._changed(later, now, self._grid.power(now.imprint - later.imprint)),
            float((lost - won) / (lost + won + _LITTLE)),
            _all_but(_STRONG, now.relief),
            irregular_pitch(field),
            self._grid.walk(before.imprint, now.imprint),
        )

    def _changed(self, before: _Look, now: _Look, moved: FloatArray) -> float:
        """Local power ``moved`` of the difference of two imprints, in shares of that of both; where it is largest.

        The difference of the stillest gel is noise of the camera, or of its coding, and no change.
        """
        both = np.square(before.relief) + np.square(now.relief)
        return _all_but(_WHERE, np.maximum(moved - np.float32(self._noise), 0) / (both + _LEAST))


def _all_but(share: float, values: FloatArray) -> float:
    """Upper bound of all but that share of the values."""
    rank = int((1 - share) * (values.size - 1))
    return float(np.partition(values.ravel(), rank)[rank])


class _Grid:
    """Sampling places of a grid's imprint, and the excluded ones."""

    def __init__(self, shape: tuple[int, ...], pitch_px: float, channels: int) -> None:
        rows, columns = shape
        self.shape = shape
        self._shrink = max(1, round(pitch_px / _SHRUNK_PITCH_PX))
        self._samples = samples = _SAMPLES if rows * columns < _LARGE_N else _SAMPLES // 2
        across, down = np.arange((columns - 1) * samples + 1), np.arange((rows - 1) * samples + 1)
        u, v = np.meshgrid(across / samples, down / samples)
        self._at = u.astype(np.float32), v.astype(np.float32)
        unmarked = (np.hypot(u - np.rint(u), v - np.rint(v)) > _MARKER).astype(np.float32)
        fine, slow = (cv2.GaussianBlur(unmarked, (0, 0), share * samples) + 1e-3 for share in (_FINE, _SLOW))
        # As often as a picture has channels: numpy is slow where it repeats along a short last axis.
        self._unmarked, self._fine, self._slow = (
            np.repeat(one[..., None], channels, 2) for one in (unmarked, fine, slow)
        )
        cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
        self._inner = np.nonzero(cv2.erode(unmarked, cross, borderType=cv2.BORDER_CONSTANT, borderValue=0))
        side = 2 * int(_AROUND * samples / 2) + 1
        self._box = (side, side)
        self._boxed = cv2.boxFilter(unmarked, cv2.CV_32F, self._box)

    def look(self, image: NDArray[np.uint8], field: MarkerField) -> _Look:
        """The imprint, percent of the light around, and its relief."""
        points = (field.rest_px + field.displacement_px).astype(np.float32)
        size = image.shape[1] // self._shrink, image.shape[0] // self._shrink
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA) if self._shrink > 1 else image
        where = (cv2.remap(points, *self._at, cv2.INTER_LINEAR) + 0.5) / self._shrink - 0.5
        picture = cv2.remap(
            small, where[..., 0], where[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        ).astype(np.float32)
        picture = picture.reshape(self._unmarked.shape)
        shown, fine_weight, slow_weight = self._weights(picture)
        lit = picture * shown
        fine, slow = (
            cv2.GaussianBlur(lit, (0, 0), share * self._samples).reshape(lit.shape) / weight
            for share, weight in ((_FINE, fine_weight), (_SLOW, slow_weight))
        )
        imprint = np.asarray(100 * (fine / np.maximum(slow, _DARK) - 1) * shown, np.float32)
        return _Look(imprint, np.sqrt(self.power(imprint)))

    def _weights(self, picture: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Places that count [h, w, channels], and the weights of both blurs; what is black lies beyond the raw frame.

        Its edge would pass for a deep imprint, and so for a strong grip.
        """
        lit: NDArray[np.bool_] | None = None if picture.min() > 0 else np.asarray(picture.any(-1))
        if lit is None or lit.all():
            return self._unmarked, self._fine, self._slow
        inner = cv2.erode(lit.astype(np.float32), _AROUND_EDGE)  # at the edge a sample is half black
        shown = np.asarray(self._unmarked * inner[..., None], np.float32)
        fine, slow = (
            np.asarray(cv2.GaussianBlur(shown, (0, 0), share * self._samples).reshape(shown.shape) + 1e-3, np.float32)
            for share in (_FINE, _SLOW)
        )
        return shown, fine, slow

    def walk(self, before: FloatArray, now: FloatArray) -> tuple[float, float]:
        """Motion of the imprint [h, w, channels] to the right and down, in pitches, in the middle of the visible part.

        Least squares on the slopes of the imprint. Added pressure, and turning about that middle, do not count.
        """
        y, x = self._inner
        mean = (before + now) / 2
        here = mean[y, x]
        left, up = (mean[y, x - 1] - mean[y, x + 1]) / 2, (mean[y - 1, x] - mean[y + 1, x]) / 2
        relief = np.square(here).sum(1) + np.float32(1e-6)
        u, v = ((at - relief @ at / relief.sum())[:, None] for at in (x, y))
        terms = np.stack([here, left, up, up * u - left * v], -1).reshape(-1, len(_RIDGE)).astype(np.float64)
        moved = np.linalg.solve(terms.T @ terms + len(terms) * _RIDGE, terms.T @ (now - before)[y, x].ravel())
        return float(moved[1] / self._samples), float(moved[2] / self._samples)

    def power(self, imprint: FloatArray) -> FloatArray:
        """Local mean square [h, w] of the visible part of an imprint [h, w, channels]."""
        squared = reduce(np.add, np.square(imprint).transpose(2, 0, 1)) / imprint.shape[-1]
        return np.asarray(cv2.boxFilter(squared, cv2.CV_32F, self._box) / self._boxed, np.float32)
