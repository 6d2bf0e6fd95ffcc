"""What tells one gel from another of its kind: how far each printed marker lies off the regular grid.

A fingerprint is the base64 text of int8 [rows, columns, 2] (du, dv) in two hundredths of a pitch; -128 stands for a
marker that was not seen. Its first two bytes are rows and columns.
"""

import base64
import binascii

import numpy as np
from numpy.typing import NDArray

_UNIT = 0.005  # pitch
_ABSENT = -128
_LEAST_N = 24


def fingerprint(off: NDArray[np.float64], seen: NDArray[np.bool_]) -> str:
    """Of a resting gel: ``off`` [rows, columns, 2] in pitches from the regular grid, ``seen`` [rows, columns]."""
    steps = np.clip(np.round(off / _UNIT), -127, 127)
    coded = np.where(seen[..., None], steps, _ABSENT).astype(np.int8)
    return base64.b64encode(bytes(seen.shape) + coded.tobytes()).decode("ascii")


def likeness(one: str, other: str) -> float | None:
    """Correlation (-1 .. 1) of two fingerprints, one gel if near 1; None if their grids differ or too little is seen.

    Raises ValueError if either is no fingerprint.
    """
    a, b = _decoded(one), _decoded(other)
    if a.shape != b.shape:
        return None
    both = (a[..., 0] != _ABSENT) & (b[..., 0] != _ABSENT)
    if both.sum() < _LEAST_N:
        return None
    x, y = (values[both] - values[both].mean(0) for values in (a.astype(float), b.astype(float)))
    size = float(np.sqrt(np.square(x).sum() * np.square(y).sum()))
    return float((x * y).sum()) / size if size > 0 else None


def _decoded(text: str) -> NDArray[np.int8]:
    try:
        coded = base64.b64decode(text, validate=True)
        return np.frombuffer(coded[2:], np.int8).reshape(coded[0], coded[1], 2)
    except (binascii.Error, IndexError, ValueError) as error:
        raise ValueError(f"no fingerprint of a gel: {text[:20]!r}") from error
