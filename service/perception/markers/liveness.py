"""Whether a picture is new: camera noise never repeats, even where nothing in the picture moves.

A faulty source may repeat one picture with fresh noise; each copy then differs from the one before like any live frame.
But the copies scatter around their original: two of them are nearer to it than to each other, by a factor of two in
squared distance whatever the strength of either noise. Live frames at rest are all equally far from each other, and
motion only increases the distance to an earlier frame.

The first copy is nearer to its original than to the frame before that, which it shares with a gel that moves. There
neighbouring markers move together; between copies only the tracker's error moves them. So a first copy is doubted.
"""

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from service.perception.markers.field import MarkerField

NEARER = 1.15  # squared distances: live frames at rest show 0.95 to 1.05, copies 2, strongly compressed 1.25
TOGETHER = 0.2  # correlation of neighbouring markers' steps: copies show 0.1 at most, a gel that moves 0.8

Grain = NDArray[np.float32]


class Liveness:
    """Follows one finger's pictures, and distinguishes copies from new ones.

    A copy is detected from the second one on, if the original was seen and had noise of its own. A picture that stood
    still before looks live, except that of the open hand, which a grasp changes. A light grip that has neither moved
    the markers nor changed the shading must at least have changed the grain.

    ``certain_ns``: capture stamp of the newest picture that is no copy: the newest, or the one before where only the
    next one will tell.
    """

    def __init__(self) -> None:
        self.certain_ns = 0
        self._field: MarkerField | None = None
        self._last: Grain | None = None
        self._before: Grain | None = None
        self._original: Grain | None = None
        self._open: Grain | None = None
        self._armed_n = 0
        self._changed = True

    def learn_open(self, image: NDArray[np.uint8]) -> None:
        """Take the rectified frame uint8 [H, W, 3] as one of the open hand."""
        self._open = _grain(image)

    def rearm(self) -> None:
        """The next frame shows a held object, let go by whatever pressed it in the last frames: they are no series."""
        self._armed_n, self._changed, self._before = 0, self._open is None, None

    def checked(self, image: NDArray[np.uint8], field: MarkerField, *, changed: bool) -> MarkerField:
        """The field tracked in a rectified frame uint8 [H, W, 3]; a "duplicate" where the frame is a copy.

        ``changed``: whether its markers or its shading differ from the open gel's.
        """
        if not field.usable:
            return field
        grain, self._changed = _grain(image), self._changed or changed
        reason = self._repeated(grain)
        doubted = self._nears(grain) and _shared_motion(self._field, field) < TOGETHER
        self.certain_ns = self._field.captured_ns if doubted and self._field else field.captured_ns
        self._before, self._last, self._field, self._armed_n = self._last, grain, field, self._armed_n + 1
        return replace(field, status="duplicate", reason=reason) if reason else field

    def _repeated(self, grain: Grain) -> str:
        """Why the picture is not new, or ""."""
        original = self._before if self._original is None else self._original
        copied = _nearer(original, self._last, grain, 1.0 / NEARER)
        self._original = original if copied else None
        if copied:
            return "the frame repeats an earlier one beneath fresh noise"
        if not self._changed and self._armed_n:
            self._changed = not _nearer(self._open, self._last, grain, NEARER)
            if not self._changed:
                return "the picture has not changed since the hand was open"
        return ""

    def _nears(self, grain: Grain) -> bool:
        """Whether the picture is nearer to the last one than to the one before."""
        if self._before is None or self._last is None:
            return False
        return bool(_apart(self._before, grain) > NEARER * _apart(self._last, grain))


def _nearer(original: Grain | None, one: Grain | None, other: Grain, times: float) -> bool:
    """Whether both pictures are nearer to the original than this factor times their mutual distance."""
    if original is None or one is None:
        return False
    away = max(_apart(original, one), _apart(original, other))
    return bool(away < times * _apart(one, other))


def _apart(one: Grain, other: Grain) -> float:
    return float(cv2.norm(one, other, cv2.NORM_L2SQR))


def _shared_motion(before: MarkerField | None, now: MarkerField) -> float:
    """Correlation of the steps of neighbouring markers since the field before: 1 where the gel shifts, 0 for errors."""
    if before is None or before.valid.shape != now.valid.shape:
        return 0.0
    known = before.valid & now.valid
    steps = np.where(known[..., None], now.displacement_px - before.displacement_px, 0.0)
    pairs_n = (known[1:] & known[:-1]).sum() + (known[:, 1:] & known[:, :-1]).sum()
    own, shared = np.square(steps).sum(), (steps[1:] * steps[:-1]).sum() + (steps[:, 1:] * steps[:, :-1]).sum()
    return float(shared / pairs_n * known.sum() / own) if pairs_n and own > 0.0 else 0.0


def _grain(image: NDArray[np.uint8]) -> Grain:
    """Detail finer than a few pixels in the middle of the picture's green channel: flickering light is coarser."""
    height, width = image.shape[:2]
    middle = image[height // 4 : -(height // 4), width // 4 : -(width // 4), 1].astype(np.float32)
    return np.asarray(middle - cv2.blur(middle, (3, 3)), np.float32)
