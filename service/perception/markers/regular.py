"""Regularity of a grid of markers.

Markers are printed in a regular grid, which a lens distorts as a whole. Any pressure on the gel disturbs it, however
smooth the object and however faint its imprint.
"""

from functools import cache

import numpy as np
from numpy.typing import NDArray

from service.perception.markers.field import MarkerField

_KEPT = 0.95  # share of the markers: the worst few may be worn or mistaken
_FEWEST_N = 20  # markers; twice the parameters of the distorted print


def irregular_pitch(field: MarkerField) -> float:
    """Deviation of the markers from a regular print seen through a lens, RMS in pitches; infinite with too few."""
    may = field.valid
    if not field.usable or may.sum() < _FEWEST_N:
        return np.inf
    terms = bent_print(*may.shape)[may]
    points = (field.rest_px + field.displacement_px)[may].astype(np.float64)
    squares = terms.T @ terms + 1e-9 * np.eye(terms.shape[1])
    off = points - terms @ np.linalg.solve(squares, terms.T @ points)
    squared = np.sort(np.square(off).sum(1))
    return float(np.sqrt(squared[: int(_KEPT * len(squared))].mean()) / field.pitch_px)


@cache
def bent_print(rows: int, columns: int) -> NDArray[np.float64]:
    """Terms [rows, columns, 10] of a grid of any place, size, turn and tilt, with radial distortion to fifth order."""
    row, column = np.mgrid[0:rows, 0:columns].astype(np.float64)
    size = 2 / max(rows - 1, columns - 1)
    u, v = (column - (columns - 1) / 2) * size, (row - (rows - 1) / 2) * size
    r2 = u * u + v * v
    return np.stack([np.ones_like(u), u, v, u * v, u * u, v * v, u * r2, v * r2, u * r2 * r2, v * r2 * r2], -1)
