"""The open gel in a recording that does not say which of its frames show it.

The most open frame is the one in which both gels are smoothest between their markers. It is believed to show open gels
if touched frames stand out from it by more than the other way round (an imprint adds edges, and `changed_grey` is not
symmetric), or if a gel comes back to it after a touch. A recording in which an object is held from the first frame to
the last has no such frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from service.perception.slip.open_gel import OpenGelSettings, Spanned, changed_grey, spanned

_EXPOSED_N = 3  # first frames, whose exposure is not found yet
_TINTED = 0.15  # a picture whose colour is off the usual one by this share is exposed otherwise
_MARKER = np.ones((5, 5), np.uint8)  # shrunk px; closes dark markers
_AROUND_PX = (9, 9)
_ROUGH = 0.06  # of the picture; where the imprint is
_CALM_N = 5  # frames
_NEARLY = 1.1  # times as rough as the smoothest
_TRIED_N = 6
_APART_N = 8  # frames
_STANDS_OUT = 1.18  # times as much as the other way round: of twelve grasps without an open frame none has 1.15
_ASKED_N = 7
_WHILE_N = 4  # frames; a touch, or its absence, that is seen for so long is one


Pictures = Sequence[NDArray[np.uint8]]


@dataclass(frozen=True, slots=True)
class OpenFrame:
    """The most open frame of a run, and whether it is shown to be open; None where hardly any other frame differs."""

    frame: int
    is_open: bool | None


def open_frame(fingers: Sequence[Pictures]) -> OpenFrame:
    """The frame in which all gels are most open; of each finger the :func:`shrunk` pictures, uint8 [h, w, channels]."""
    frames_n = min(len(pictures) for pictures in fingers)
    rough = np.sum([_roughness(pictures[:frames_n]) for pictures in fingers], 0)
    rough[: min(_EXPOSED_N, frames_n - 1)] = np.inf
    calm = np.convolve(np.pad(rough, _CALM_N // 2, "edge"), np.ones(_CALM_N), "valid")
    calm = np.where(np.isfinite(rough), calm, np.inf)
    found = [(frame, [_shown(pictures, frame) for pictures in fingers]) for frame in _smoothest(calm)]
    frame, shown = max(found, key=lambda one: one[1].count("returns"))  # the first of those that are alike
    return OpenFrame(frame, None if set(shown) == {"unchanged"} else not set(shown).isdisjoint({"returns", "clearest"}))


def _smoothest(calm: NDArray[np.float64]) -> list[int]:
    """The smoothest frame, and others that are nearly as smooth and not near one another."""
    chosen: list[int] = []
    for frame in np.argsort(calm, kind="stable").tolist():
        if calm[frame] > _NEARLY * calm.min() or len(chosen) == _TRIED_N:
            break
        if all(abs(frame - other) >= _APART_N for other in chosen):
            chosen.append(frame)
    return chosen or [0]


def _roughness(pictures: Pictures) -> NDArray[np.float64]:
    """How rough the gel looks between its markers, 1 as usual, frame by frame; infinite where exposed otherwise."""
    tint = np.array([np.median(picture.reshape(-1, picture.shape[-1]), 0) for picture in pictures])
    usual = np.abs(tint / np.maximum(np.median(tint, 0), 1.0) - 1).max(1) < _TINTED
    rough = np.array([_rough(picture) for picture in pictures])
    return np.where(usual, rough / max(float(np.median(rough)), 1e-9), np.inf)


def _rough(picture: NDArray[np.uint8]) -> float:
    closed = cv2.morphologyEx(picture, cv2.MORPH_CLOSE, _MARKER).astype(np.float32)
    edges = np.abs(closed - cv2.blur(closed, _AROUND_PX)).reshape(*picture.shape[:2], -1).max(-1)
    inner = edges[4:-4, 4:-4].ravel()
    count = max(1, int(_ROUGH * inner.size))
    return float(np.partition(inner, -count)[-count:].mean())


def _shown(pictures: Pictures, frame: int) -> Literal["unchanged", "returns", "clearest", "no"]:
    """What shows that a finger's gel is open in a frame.

    Hardly any other frame differs, or the gel comes back to it after a touch, or touched frames stand out from it.
    """
    opened = _spanned(pictures[frame])
    seen = [_spanned(picture) for picture in pictures[:: max(1, len(pictures) // 150)]]
    changed = np.array([_changed(one, than=opened) for one in seen])
    touched = changed > OpenGelSettings().shade_grey
    if touched.sum() < _ASKED_N:
        return "unchanged"
    if _returns(touched):
        return "returns"
    asked = np.flatnonzero(touched)[np.linspace(0, touched.sum() - 1, _ASKED_N).astype(int)]
    back = np.array([_changed(opened, than=seen[k]) for k in asked])
    return "clearest" if float(np.median(np.exp(_stands_out(changed[asked], back)))) >= _STANDS_OUT else "no"


def _returns(touched: NDArray[np.bool_]) -> bool:
    """Whether the gel is seen open for a while both before and after it is touched for a while."""
    steady = np.array([touched[k : k + _WHILE_N].mean() for k in range(max(0, len(touched) - _WHILE_N + 1))])
    held, free = np.flatnonzero(steady == 1.0), np.flatnonzero(steady == 0.0)
    return len(held) > 0 and len(free) > 0 and bool(np.any((free[0] < held) & (held < free[-1])))


def _spanned(picture: NDArray[np.uint8]) -> Spanned:
    return spanned(picture.astype(np.float32))


def _changed(one: Spanned, *, than: Spanned) -> float:
    """As :func:`changed_grey`, 0 where the light differs by too much to compare."""
    return changed_grey(one.picture, than, OpenGelSettings().shade_area) or 0.0


def _stands_out(this: NDArray[np.float64], that: NDArray[np.float64]) -> NDArray[np.float64]:
    """Logarithm, -1 .. 1, of how much more pictures stand out (``this``) than the other way round (``that``)."""
    seen = (np.maximum(this, that) > OpenGelSettings().shade_grey) & (np.minimum(this, that) > 0)
    return np.where(seen, np.clip(np.log(np.maximum(this, 1.0) / np.maximum(that, 1.0)), -1, 1), 0.0)
