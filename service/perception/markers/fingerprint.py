"""Identity of a gel among others of its kind: the offset of each printed marker from the regular grid.

A fingerprint is the base64 text of int8 [rows, columns, 2] (du, dv) in two hundredths of a pitch; -128 stands for an
invisible marker. Its first two bytes are rows and columns.
"""

import base64
import binascii
import hashlib

import numpy as np
from numpy.typing import NDArray

from service.perception.markers.field import MarkerField

_UNIT = 0.005  # pitch
_ABSENT = -128
_LEAST_N = 24
OTHER_GEL = 0.5  # likeness below which two fingerprints certainly belong to two gels of a kind
TELLING_N = 150  # markers; with fewer, too much depends on which are found for a gel to be refused


def fingerprint(off: NDArray[np.float64], visible: NDArray[np.bool_]) -> str:
    """Fingerprint of a resting gel: ``off`` [rows, columns, 2] in pitches from the grid, ``visible`` [rows, cols]."""
    steps = np.clip(np.round(off / _UNIT), -127, 127)
    coded = np.where(visible[..., None], steps, _ABSENT).astype(np.int8)
    return base64.b64encode(bytes(visible.shape) + coded.tobytes()).decode("ascii")


def fingerprint_of(field: MarkerField) -> str:
    """Fingerprint of a resting gel in a rectified frame; empty where it shows no grid."""
    if not field.valid.any():
        return ""
    cells = np.argwhere(field.valid)
    off = np.zeros((*field.valid.shape, 2))
    now = (field.rest_px + field.displacement_px)[field.valid].astype(np.float64)
    off[field.valid] = off_print(cells.astype(np.float64), now) / field.pitch_px
    return fingerprint(off, field.valid)


def gel_name(fingerprint: str) -> str:
    """A short name of a gel; it changes with each calibration."""
    return hashlib.sha256(fingerprint.encode()).hexdigest()[:12]


def off_print(cells: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distances of points [n, 2] from the best-fitting regular grid, px; ``cells`` [n, 2]: row and column."""
    terms = np.column_stack([cells, np.ones(len(cells))])
    fit, _, _, _ = np.linalg.lstsq(terms, points, rcond=None)
    return np.asarray(points - terms @ fit)


def likeness(one: str, other: str) -> float | None:
    """Correlation (-1 .. 1) of two fingerprints, one gel if near 1; None if either is empty or their grids differ.

    Raises ValueError if either is not a fingerprint.
    """
    if not (one and other):
        return None
    a, b = _decoded(one), _decoded(other)
    if a.shape != b.shape:
        return None
    both = (a[..., 0] != _ABSENT) & (b[..., 0] != _ABSENT)
    if both.sum() < _LEAST_N:
        return None
    x, y = (values[both] - values[both].mean(0) for values in (a.astype(float), b.astype(float)))
    size = float(np.sqrt(np.square(x).sum() * np.square(y).sum()))
    return float((x * y).sum()) / size if size > 0 else None


def check_fingerprint(text: str) -> None:
    """Raise ValueError unless the text is a fingerprint, or empty: that of an unknown gel."""
    if text:
        _decoded(text)


def _decoded(text: str) -> NDArray[np.int8]:
    try:
        coded = base64.b64decode(text, validate=True)
        return np.frombuffer(coded[2:], np.int8).reshape(coded[0], coded[1], 2)
    except (binascii.Error, IndexError, ValueError) as error:
        raise ValueError(f"no fingerprint of a gel: {text[:20]!r}") from error
