"""Seconds and forces of insertions, with intervals of 95 %: bootstrap over the starts."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from reporting.statistics import Estimate, bootstrap
from simulation.closed_loop.statistics import Row

DRAWS = 2000


def total_s(row: Row) -> float:
    """Seconds of an insertion."""
    return float(sum(row["seconds"].values()))


def _draws(count: int) -> NDArray[np.int64]:
    """Resampled starts [DRAWS, count], the same for every point; the first draw is all."""
    draws = np.random.default_rng(0).integers(0, count, (DRAWS, count))
    draws[0] = np.arange(count)
    return draws


def upper(values: Sequence[float]) -> Estimate:
    """Upper limit of 95 % of the values."""
    each = np.quantile(np.array(values)[_draws(len(values))], 0.95, axis=1)
    return bootstrap(float(each[0]), each.tolist())


def _sums(rows: Sequence[Row]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Seconds and boxes of resampled starts [DRAWS]."""
    draws = _draws(len(rows))
    seconds, boxes = np.array([total_s(row) for row in rows]), np.array([float(row["inserted"]) for row in rows])
    return seconds[draws].sum(1), np.maximum(boxes[draws].sum(1), 0.5)


def a_box(rows: Sequence[Row]) -> Estimate:
    """Total seconds over the number of inserted boxes."""
    seconds, boxes = _sums(rows)
    each = seconds / boxes
    return bootstrap(float(each[0]), each.tolist())


def faster(rows: Sequence[Row], first: Sequence[Row]) -> Estimate:
    """Ratio of the seconds per box of ``first`` to these, from the same starts."""
    (seconds, boxes), (first_seconds, first_boxes) = _sums(rows), _sums(first)
    ratio = (first_seconds / first_boxes) / (seconds / boxes)
    return bootstrap(float(ratio[0]), ratio.tolist())
