"""Whether a picture is new: camera noise never repeats, even where nothing in the picture moves.

A faulty source may repeat one picture with fresh noise; each copy then differs from the one before like any live frame.
But the copies scatter around their original: two of them are nearer to it than to each other, by a factor of two in
squared distance whatever the strength of either noise. Live frames at rest are all equally far from each other, and
motion only increases the distance to an earlier frame.
"""

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from service.perception.markers.field import MarkerField

NEARER = 1.15  # squared distances: live frames at rest show 0.95 to 1.05, copies 2, strongly compressed 1.25

Grain = NDArray[np.float32]


class Liveness:
    """Follows one finger's pictures, and distinguishes copies from new ones.

    A copy is detected from the second one on, if the original was seen and had noise of its own. A picture that stood
    still before looks live, except that of the open hand, which a grasp changes. A light grip that has neither moved
    the markers nor changed the shading must at least have changed the grain.
    """

    def __init__(self) -> None:
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
        self._before, self._last, self._armed_n = self._last, grain, self._armed_n + 1
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


def _nearer(original: Grain | None, one: Grain | None, other: Grain, times: float) -> bool:
    """Whether both pictures are nearer to the original than this factor times their mutual distance."""
    if original is None or one is None:
        return False
    away = max(cv2.norm(original, one, cv2.NORM_L2SQR), cv2.norm(original, other, cv2.NORM_L2SQR))
    return bool(away < times * cv2.norm(one, other, cv2.NORM_L2SQR))


def _grain(image: NDArray[np.uint8]) -> Grain:
    """Detail finer than a few pixels in the middle of the picture's green channel: flickering light is coarser."""
    height, width = image.shape[:2]
    middle = image[height // 4 : -(height // 4), width // 4 : -(width // 4), 1].astype(np.float32)
    return np.asarray(middle - cv2.blur(middle, (3, 3)), np.float32)
