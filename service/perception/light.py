"""How the light falls on a resting gel: no two sensors of a kind are lit alike, however they are exposed.

A light is the base64 text of uint8 [8, 8, 3] (BGR): the median of each part of the rectified picture, in which markers
and a little dust do not count.
"""

import base64
import binascii

import numpy as np
from numpy.typing import NDArray

_SIDE_N = 8  # parts along each side
_DARK = 0.2  # of each colour's mean, added to all parts: noise and stray light would rule the logarithms of dark ones
_SHAPE = (_SIDE_N, _SIDE_N, 3)
OTHER_LIGHT = 0.03  # from here on two lights belong to two gels; real ones: own up to 0.017, others from 0.037


def light_of(image: NDArray[np.uint8]) -> str:
    """Light of a resting gel's rectified picture uint8 [h, w, 3], 8 px a side or more."""
    height, width = (side // _SIDE_N for side in image.shape[:2])
    parts = image[: height * _SIDE_N, : width * _SIDE_N].reshape(_SIDE_N, height, _SIDE_N, width, 3)
    return base64.b64encode(np.median(parts, axis=(1, 3)).astype(np.uint8).tobytes()).decode("ascii")


def light_apart(one: str, other: str) -> float | None:
    """Mean relative difference of two lights, from 0 on; None if one is empty: not known.

    Each part counts by its share of its colour's mean, so neither exposure nor white balance matters. Raises ValueError
    if either is no light.
    """
    if not (one and other):
        return None
    return float(np.abs(_relative(one) - _relative(other)).mean())


def _relative(text: str) -> NDArray[np.float64]:
    """Logarithm of each part over its colour's mean."""
    parts = _decoded(text)
    return np.asarray(np.log(parts / np.maximum(parts.mean((0, 1)), 1.0) + _DARK))


def check_light(text: str) -> None:
    """Raise ValueError unless the text is a light, or empty: not known."""
    if text:
        _decoded(text)


def _decoded(text: str) -> NDArray[np.float64]:
    try:
        return np.frombuffer(base64.b64decode(text, validate=True), np.uint8).reshape(_SHAPE).astype(np.float64)
    except (binascii.Error, ValueError) as error:
        raise ValueError(f"no light of a gel: {text[:20]!r}") from error
