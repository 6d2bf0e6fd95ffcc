"""Figures with their 95 % intervals."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

Z95 = 1.959963984540054


class Estimate(NamedTuple):
    """A figure and the ends of its 95 % interval; in JSON a list of three numbers."""

    value: float
    low: float
    high: float

    def __format__(self, spec: str) -> str:
        """Figure and interval in one format: ``f"{estimate:.1%}"`` is ``86.0 % (77.9 .. 91.5)``; ``-`` for NaN."""
        if math.isnan(self.value):
            return number(None)
        if not spec.endswith("%"):
            return f"{number(self.value, spec)} ({number(self.low, spec)} .. {number(self.high, spec)})"
        low, high = (number(end, spec).removesuffix(" %") for end in (self.low, self.high))
        return f"{number(self.value, spec)} ({low} .. {high})"


def number(value: float | None, spec: str = "") -> str:
    """One number; a space before the per cent sign, and ``-`` for None and NaN."""
    if value is None or value != value:  # noqa: PLR0124 - only NaN differs from itself
        return "-"
    text = format(value, spec)
    return f"{text[:-1]} %" if spec.endswith("%") else text


def wilson(hits: float, count: float) -> Estimate:
    """A share and its score interval (Wilson 1927), which lies in 0..1; (nan, 0, 1) for no data."""
    if count == 0:
        return Estimate(math.nan, 0.0, 1.0)
    share, spread = hits / count, Z95**2 / count
    middle = (share + spread / 2) / (1 + spread)
    half = Z95 / (1 + spread) * math.sqrt(share * (1 - share) / count + spread / (4 * count))
    # Rounding may put an end at 0 or 1 beyond the share.
    return Estimate(share, max(0.0, min(share, middle - half)), min(1.0, max(share, middle + half)))


def clustered(hits: Sequence[float], counts: Sequence[int]) -> Estimate:
    """A share of trials that come in groups, such as those of one cell, which may end alike: one entry for each group.

    Wilson's interval for as many independent trials as would scatter as the groups do (Kish 1965), never for more than
    there are.
    """
    of, trials = np.asarray(hits, float), np.asarray(counts, float)
    total, count, groups_n = float(of.sum()), float(trials.sum()), len(trials)
    alone = total * (count - total) / count if count else 0.0  # variance of the hits if no trial knew of another
    if groups_n < 2 or alone <= 0.0:
        return wilson(total, count)
    scatter = groups_n / (groups_n - 1) * float(np.square(of - trials * total / count).sum())
    alike = max(1.0, scatter / alone)
    return wilson(total / alike, count / alike)


def mean(values: Sequence[float]) -> Estimate:
    """Mean of a sample, with the normal interval of its standard error; a point for a single value."""
    sample = np.asarray(values, float)
    error = sample.std(ddof=1) / math.sqrt(len(sample)) if len(sample) > 1 else 0.0
    value, half = float(sample.mean()), Z95 * float(error)
    return Estimate(value, value - half, value + half)


def bootstrap(value: float, resampled: Sequence[float]) -> Estimate:
    """An estimate beside its values on resampled data: the percentile interval (Efron 1979)."""
    low, high = np.percentile(resampled, (2.5, 97.5))
    return Estimate(value, float(low), float(high))


def percentiles(values: ArrayLike, *shares: float) -> list[float]:
    """Percentiles in 0..100, in the given order; NaN for no data."""
    sample = np.asarray(values, float)
    return [float(value) for value in np.percentile(sample, shares)] if sample.size else [math.nan] * len(shares)
