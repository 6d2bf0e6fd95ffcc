"""Does resident memory grow? Judged on moments of rest, with an interval that does not trust neighbouring readings.

While an insertion is under way the service holds its frames, some 10 to 30 MB that come and go: a line through such
readings says how busy the last minutes were. At rest, after an insertion is closed and before the next opens, only
what stays is left, and on a busy machine what is about to be given back. Those readings are cut into twelve
consecutive blocks; the line goes through the blocks' lower quartiles, the floor, which a reading taken too early does
not move, and its interval is Student's for these twelve, as neighbours are not independent.
"""

from dataclasses import dataclass

import numpy as np

LEAK_MB_PER_H = 20.0
SETTLING = 0.2  # of the run: libraries are still being paged in
BLOCKS = 12
T_95 = 2.228  # of Student's distribution with 10 degrees of freedom


@dataclass(frozen=True)
class Slope:
    """MB an hour with its 95 % interval; ``n`` readings."""

    mb_per_h: float
    low: float
    high: float
    n: int

    @property
    def leaks(self) -> bool:
        """Whether growth beyond the limit cannot be excluded."""
        return not self.high <= LEAK_MB_PER_H

    def __str__(self) -> str:
        return f"{self.mb_per_h:+.1f} MB an hour (95 %: {self.low:+.1f} to {self.high:+.1f}; {self.n} readings)"


def slope(at_s: list[float], mb: list[float], run_s: float) -> Slope:
    """Growth after the first fifth of a run; not a number, which counts as a leak, if there are too few readings."""
    settled = np.array([(t / 3600, value) for t, value in zip(at_s, mb, strict=True) if t >= SETTLING * run_s])
    if len(settled) < 2 * BLOCKS:
        return Slope(float("nan"), float("nan"), float("nan"), len(settled))
    blocks = np.array_split(settled, BLOCKS)
    hours = [np.mean(block[:, 0]) for block in blocks]
    floor = [np.percentile(block[:, 1], 25) for block in blocks]
    (fitted, _), covariance = np.polyfit(hours, floor, 1, cov=True)
    margin = T_95 * float(np.sqrt(covariance[0, 0]))
    return Slope(float(fitted), float(fitted) - margin, float(fitted) + margin, len(settled))
