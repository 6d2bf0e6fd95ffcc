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
_SLID = 2  # rows or columns at a border that may differ on both sides
OTHER_GEL = 0.5  # likeness below which two fingerprints certainly belong to two gels of a kind
SAME_GEL = 0.95  # likeness from which they certainly belong to one, however few markers are compared
TELLING_N = 150  # markers; with fewer, too much depends on which are found for a gel to be refused by them


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
    """Correlation (-1 .. 1) of two fingerprints, one gel if near 1; None if they share too few markers.

    They are laid on each other where they agree best: a border row may have been dirty, dark or out of view in one.

    Raises ValueError if either is not a fingerprint.
    """
    if not (one and other):
        return None
    a, b = _decoded(one), _decoded(other)
    down, right = (
        range(min(0, more) - _SLID, max(0, more) + _SLID + 1) for more in np.subtract(a.shape, b.shape)[:2].tolist()
    )
    alike = [_correlation(a, b, i, j) for i in down for j in right]
    return max((known for known in alike if known is not None), default=None)


def _correlation(a: NDArray[np.int8], b: NDArray[np.int8], i: int, j: int) -> float | None:
    """Of the markers that are visible in both, if the first of ``b`` lies ``i`` rows and ``j`` columns off that of a.

    The offsets of each are taken from the regular grid that fits these markers best.
    """
    top, bottom = max(i, 0), min(len(a), i + len(b))
    left, right = max(j, 0), min(a.shape[1], j + b.shape[1])
    a, b = a[top:bottom, left:right], b[top - i : bottom - i, left - j : right - j]
    both = (a[..., 0] != _ABSENT) & (b[..., 0] != _ABSENT)
    if both.sum() < _LEAST_N:
        return None
    x, y = (off_print(np.argwhere(both).astype(float), values[both].astype(float)) for values in (a, b))
    size = float(np.sqrt(np.square(x).sum() * np.square(y).sum()))
    return float((x * y).sum()) / size if size > 0 else None


def markers_n(fingerprint: str) -> int:
    """Markers that a fingerprint holds; none of an unknown gel."""
    return int((_decoded(fingerprint)[..., 0] != _ABSENT).sum()) if fingerprint else 0


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
