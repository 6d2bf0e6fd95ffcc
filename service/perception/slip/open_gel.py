"""Whether anything touches a gel, by comparison with the same gel open: its shading, and its markers' places.

A pressed gel changes colour where its surface tilts, and carries its markers along. The picture is compared with that
of the open gel after both were shrunk and one factor has removed the exposure. A pixel counts as changed only beyond
the range of its neighbours in the open picture: a marker that returned a little beside its place changes nothing.

Without a picture of the open gel only the markers count: in an open gel they lie at their learnt places or, if no frame
of it was learnt, at their printed places, on a sensor whose rectified image shows a regular grid. A sensor whose lens
bends its grid is then never called open, and slip is detected as if something were held.
"""

from dataclasses import replace
from functools import reduce
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from service.perception.markers.field import MarkerField, median
from service.perception.markers.fingerprint import off_print
from service.perception.slip.rigid import Float64

Picture = NDArray[np.float32]
_KEPT = 0.95  # share of the markers that count: the worst few may be worn, broken or mistaken
_HALVED_N = 2  # halvings; four image px per side become one, a quarter of a millimetre on the present sensors
_AROUND = np.ones((3, 3), np.uint8)
_SLID = 0.5  # pitch; if all markers are further off than this, they were mistaken for their neighbours
_EXPOSED = 1.3  # times the open gel's light; beyond, the camera is still adjusting its exposure

# Limits from which a gel is touched, lengths in shares of the pitch.
_SHADE_GREY = 4.5  # largest change in grey levels of all but the most changed part of the picture
_SHADE_AREA = 0.02  # that part
HOME_PITCH = 0.018  # RMS, from a learnt frame; real gels return to 0.016, 2 N on a flat object move them by 0.02
_PRINT_PITCH = 0.012  # from a regular grid of free place, size and turn, exceeded from a press of 8 N on
_WORN_PITCH = 0.06  # if a picture is known as well: real markers need not have returned completely
_VALID_SHARE = 0.6  # share of the markers; fewer carry no information
# Mean downward displacement of all markers under a held weight. In no frame of 22 real runs did both open gels show it
# before a grasp, and in 0.5 % of those after a loss.
WEIGHT_PITCH = 0.005


class OpenGel:
    """One finger's open gel: learnt before the grasp, or inferred from the regularity of its print."""

    def __init__(self) -> None:
        self._home: MarkerField | None = None
        self._spanned: Spanned | None = None
        self._weighed: tuple[MarkerField | None, float | None] = None, None  # the last field, and its bulge

    def learn(self, field: MarkerField, picture: Picture | None = None) -> None:
        """Take ``field``, and the :func:`shrunk` picture behind it, as those of the open gel.

        Raises ValueError if the field shows no markers.
        """
        if not field.valid.any():
            raise ValueError(f"an untouched gel cannot be learnt from a frame without markers: {field.reason}")
        self._home, self._weighed = field, (None, None)
        self._spanned = None if picture is None else spanned(picture)

    def mark(self, field: MarkerField) -> MarkerField:
        """The field with an empty contact if its markers show an open gel, else unchanged (its contact is unknown)."""
        if field.contact is not None:
            return field
        bulge = self.bulge(field)
        if bulge is None or bulge >= 1:
            return field
        return replace(field, contact=np.zeros_like(field.valid))

    def touch(self, field: MarkerField, picture: Picture | None = None) -> float | None:
        """Strength of the touch on the gel, touched from 1 on; None if unknown."""
        bulge = self.bulge(field)
        if picture is None or self._spanned is None:
            return bulge
        shade = self.shade(picture)
        away_pitch = 0.0 if bulge is None else bulge * HOME_PITCH
        if shade is None or away_pitch > _SLID:
            return shade
        return max(shade, away_pitch / _WORN_PITCH)

    def shade(self, picture: Picture) -> float | None:
        """Difference of a :func:`shrunk` picture from the open gel's, touched from 1 on; None: unlearnt or unlike."""
        if self._spanned is None or self._spanned.picture.shape != picture.shape:
            return None
        changed = changed_grey(picture, self._spanned, _SHADE_AREA)
        return None if changed is None else changed / _SHADE_GREY

    def bulge(self, field: MarkerField) -> float | None:
        """RMS displacement of the markers over the limit of an untouched gel; None: not visible."""
        if self._weighed[0] is not field:
            self._weighed = field, self._bulge(field)
        return self._weighed[1]

    def weight(self, field: MarkerField) -> float | None:
        """Mean downward displacement of all markers from the open gel, something's weight from 1 on.

        None: not visible, or no frame of the open gel was learnt. A stiff gel in a light grip may show this and no
        bulge.
        """
        load = self.load(field)
        return None if load is None else float(load[1]) / WEIGHT_PITCH

    def load(self, field: MarkerField) -> Float64 | None:
        """Mean displacement of all markers from the open gel, right and down, in pitches; None where `weight` is."""
        may = self._comparable(field)
        if self._home is None or may is None:
            return None
        return np.asarray(self._from_home(field, self._home, may).mean(0) / field.pitch_px)

    def _bulge(self, field: MarkerField) -> float | None:
        may = self._comparable(field)
        if may is None:
            return None
        if self._home is None:
            now = (field.rest_px + field.displacement_px)[may].astype(np.float64)
            off, limit = off_print(np.argwhere(may).astype(np.float64), now), _PRINT_PITCH
        else:
            off, limit = self._from_home(field, self._home, may), HOME_PITCH
        return _spread(off) / (limit * field.pitch_px)

    def _comparable(self, field: MarkerField) -> NDArray[np.bool_] | None:
        """The markers visible both now and in the open gel; None if they are too few."""
        may = field.valid
        if self._home is not None and field.usable:
            if self._home.valid.shape != may.shape:
                return None
            may = may & self._home.valid
        enough = field.usable and may.sum() >= max(12, _VALID_SHARE * may.size)
        return may if enough else None

    @staticmethod
    def _from_home(field: MarkerField, home: MarkerField, may: NDArray[np.bool_]) -> Float64:
        now, then = (one.rest_px + one.displacement_px for one in (field, home))
        return np.asarray((now - then)[may], np.float64)


def shrunk(image: NDArray[np.uint8]) -> Picture:
    """The image uint8 [h, w, 3] or [h, w] as float32 [h / 4, w / 4, channels]: means of squares, thus without noise.

    Halved twice, which is a tenth of the work; the remainder at the right and lower border is cut off.
    """
    small = image
    for _ in range(_HALVED_N):
        height, width = small.shape[0] // 2, small.shape[1] // 2
        halved = cv2.resize(small[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA)
        small = np.asarray(halved, np.uint8)
    return small.reshape(*small.shape[:2], -1).astype(np.float32)


class Spanned(NamedTuple):
    """A :func:`shrunk` picture, and its least and largest values around each pixel."""

    picture: Picture
    low: Picture
    high: Picture


def spanned(picture: Picture) -> Spanned:
    """The picture with its local ranges."""
    low, high = (np.asarray(grow(picture, _AROUND), np.float32) for grow in (cv2.erode, cv2.dilate))
    return Spanned(picture, low.reshape(picture.shape), high.reshape(picture.shape))


def changed_grey(picture: Picture, than: Spanned, area: float) -> float | None:
    """Grey levels by which ``picture`` leaves the range of ``than`` around each pixel, except for the worst ``area``.

    None where the light differs by too much to compare.
    """
    gain = median((picture[::4, ::4] / np.maximum(than.picture[::4, ::4], 1.0)).ravel())
    if not 1 / _EXPOSED < gain < _EXPOSED:
        return None
    lit = picture * np.float32(1 / gain)
    beyond = reduce(np.maximum, np.maximum(lit - than.high, than.low - lit).transpose(2, 0, 1)).ravel()
    rank = min(beyond.size - 1, int((1 - area) * beyond.size))
    return max(0.0, float(np.partition(beyond, rank)[rank]))


def _spread(off: Float64) -> float:
    """RMS length of the deviations [n, 2], except for the worst few."""
    squared = np.sort(np.square(off).sum(-1))
    return float(np.sqrt(squared[: max(1, int(_KEPT * len(squared)))].mean()))
