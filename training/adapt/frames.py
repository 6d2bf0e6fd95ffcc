"""The gap's true position in the frame taught to the arm, from probes on both sides of it.

A probe's error is stated in the arm's frame. If the tool or the fixture is off, all of them are off by the same amount,
and a network that learnt them would steer every part beside the gap. The release answers symmetrically on both sides,
so the error at which it answers zero is the gap.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from training.data.episodes import PROBE
from training.data.pressed import Pressed

USUAL = np.array([2.0, 2.0])
"""Usual errors of tools and fixtures, one sigma: mm, deg."""
LEAST_GAIN = 0.3
"""Least slope of the release's answers in a cell: below it, they do not determine the gap."""
LEAST_N = 8
ZERO = np.array([0.5, 0.35])
"""How far cameras and parts move the release's own zero, one sigma: mm, deg. Of 12 drawn cells (decision 141)."""


class Gap(NamedTuple):
    """The gap's position in the taught frame (mm, deg), one sigma of it, and the number of probes behind it."""

    at: tuple[float, float]
    sigma: tuple[float, float]
    probes_n: int


def find_gap(stated: NDArray[np.float64], estimates: NDArray[np.float64], grasps: NDArray[np.str_]) -> Gap:
    """Stated error [N, 2] at which the release answers 0: a line through its ``estimates`` [N, 2], pulled to 0.

    Its sigma counts what the probes of a grasp have in common, such as how the object hangs, and `ZERO`. 0 with the
    sigma of USUAL on an axis that the release does not sense, or with fewer than LEAST_N probes.
    """
    at, sigma = np.zeros(2), USUAL.copy()
    if len(stated) >= LEAST_N:
        known = np.column_stack([stated, np.ones(len(stated))])
        inverse = np.linalg.pinv(known.T @ known)
        line = inverse @ known.T @ estimates
        rest = estimates - known @ line
        for axis in range(2):
            gain = line[axis, axis]
            if gain < LEAST_GAIN:
                continue
            alike = _alike(rest[:, axis], np.unique(grasps, return_inverse=True)[1])
            scatter = float(np.sqrt(alike * rest[:, axis].var(ddof=3) * inverse[2, 2])) / gain
            error = float(np.hypot(scatter, ZERO[axis]))
            share = USUAL[axis] ** 2 / (USUAL[axis] ** 2 + error**2)
            at[axis], sigma[axis] = -share * line[2, axis] / gain, np.sqrt(share) * error
    return Gap((float(at[0]), float(at[1])), (float(sigma[0]), float(sigma[1])), len(stated))


def _alike(rest: NDArray[np.float64], grasps: NDArray[np.int64]) -> float:
    """How many times the variance of the mean is that of as many independent values (Kish 1965), at least 1."""
    grasps_n = int(grasps.max()) + 1
    if grasps_n == 1:
        return float(len(rest))
    scatter = grasps_n / (grasps_n - 1) * float(np.square(np.bincount(grasps, rest)).sum())
    return max(1.0, scatter / float(np.square(rest).sum()))


def framed(samples: Pressed, estimates: NDArray[np.float64]) -> tuple[Pressed, Gap]:
    """The samples with the probes' errors relative to the gap; ``estimates`` [N, 2] are the release's."""
    probes = samples.objects == PROBE
    gap = find_gap(samples.error[probes].astype(np.float64), estimates[probes], samples.groups[probes])
    error = samples.error - np.where(probes[:, None], gap.at, 0.0).astype(np.float32)
    return replace(samples, error=error), gap
