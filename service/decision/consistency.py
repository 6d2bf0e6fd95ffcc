"""Whether the estimates of an insertion follow from the moves that were commanded between them.

A cell that is wired wrong on its first day answers a good correction with a larger error, or with one out of the range
that the networks know. So the error is followed through the attempts as a Kalman filter would, by what the estimates
and the commanded corrections say: once as commanded, and once with x, yaw or both reversed. Which of them expected the
estimates? A picture that is mirrored shows itself at once: both fingers see the object turn from opposite sides, a
mirrored one from the same side.

The constants were fitted on 855 insertions in good cells, drawn and mid-range, which reach odds of 90 at most, and on
15 in reversed ones, half of which then are named (simulated, released networks). In a cell where the networks were sure
of themselves once, as in the middle of their range, an estimate that is not says only that much.
"""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from service.contract.wire import Correction
from service.contract.words.wiring import WIRINGS
from service.decision.evidence import Refusal
from service.perception.observation import PairObservation

Pair = NDArray[np.float64]  # x mm, theta deg
Signs = tuple[int, int]

ODDS = math.log(150.0)  # that a reversed cell must have against a good one
NAMED = math.log(20.0)  # causes that explain it this much worse than the best one are named, too
FITS = np.array([3.0, 4.0])  # such an error is often within the gap's clearance, and then not blocked
FITS_BLOCKED = 0.4
MODEL_SIGMA = np.array([1.0, 2.0])  # beyond what the networks say of themselves
WALK_SIGMA = np.array([1.5, 2.0])  # that a correction adds
UNKNOWN = np.array([50.0, 50.0])  # one sigma of an estimate that has none
OUTLIERS, RANGE = 0.05, 40.0
FAR = np.array([15.0, 14.0])  # beyond, the networks often answer with hardly any error at all
FAR_OUTLIERS, FAR_SIGMA = 0.5, 4.0
SURE = np.array([2.2, 5.0])  # one sigma. Networks that were so sure once seldom are in doubt in that cell, but for far
SURE_SHARE, FAR_SURE_SHARE = 0.93, 0.35
JUDGED_N = 8  # attempts. All reversed cells were named by the sixth, the two good ones that were after ten and fourteen
LEAST_TURN_DEG, LIKE = 1.0, 0.5  # the smaller turn is at least this share of the larger


class Expected:
    """The error that one way of wiring expects, and its variance; both [2]."""

    def __init__(self, mean: Pair, variance: Pair) -> None:
        self.mean, self.variance = mean, variance

    @property
    def far(self) -> bool:
        """Whether it is out of the range that the networks know."""
        return bool((np.abs(self.mean) > FAR).any())

    @property
    def blocked(self) -> float:
        """Log-likelihood that it blocks an attempt."""
        return math.log(FITS_BLOCKED) if (np.abs(self.mean) < FITS).all() else 0.0

    def log_share(self, *, sure: bool) -> float:
        """Log-likelihood that networks which know their cell are sure, or are not."""
        share = FAR_SURE_SHARE if self.far else SURE_SHARE
        return math.log(share if sure else 1.0 - share)

    def log_likelihood(self, seen: Pair, variance: Pair) -> float:
        """Of an estimate; an outlier may be anywhere in the range."""
        outliers = FAR_OUTLIERS if self.far else OUTLIERS
        stray = _density(seen, variance + FAR_SIGMA**2) if self.far else 1.0 / RANGE
        density = (1.0 - outliers) * _density(seen - self.mean, self.variance + variance) + outliers * stray
        return float(np.log(density).sum())

    def learn(self, seen: Pair, variance: Pair) -> None:
        """Take in an estimate; of what is far the networks know nothing."""
        gain = np.zeros(2) if self.far else self.variance / (self.variance + variance)
        self.mean, self.variance = self.mean + gain * (seen - self.mean), (1.0 - gain) * self.variance

    def move(self, command: Pair) -> None:
        """Go on after a correction."""
        self.mean, self.variance = self.mean + command, self.variance + np.square(WALK_SIGMA)


@dataclass(slots=True)
class Consistency:
    """The log-likelihood of each way that a cell may be wired, given the attempts so far."""

    _log: dict[Signs, float] = field(default_factory=lambda: dict.fromkeys([(1, 1), *WIRINGS], 0.0))
    _expected: dict[Signs, Expected] = field(default_factory=dict)
    _sure_once: bool = False
    _attempts_n: int = 0

    def add(self, correction: Correction, both: PairObservation) -> None:
        """Take in an attempt's correction and last pair. Raises Refusal that names the likely causes."""
        if mirrored(both):
            raise Refusal("contradictory", "both fingers see the object turn the same way: one picture is mirrored")
        self._attempts_n += 1
        if self._attempts_n > JUDGED_N:
            return
        estimate = correction.estimate
        seen = np.array([estimate.dx_mm, estimate.dtheta_deg])
        sigma = np.array([estimate.sigma_x_mm or UNKNOWN[0], estimate.sigma_theta_deg or UNKNOWN[1]])
        sure, variance = bool((sigma < SURE).all()), np.square(sigma) + np.square(MODEL_SIGMA)
        for signs, expected in self._expected.items():
            self._log[signs] += expected.blocked
            if self._sure_once:
                self._log[signs] += expected.log_share(sure=sure)
            if sure or not self._sure_once:
                self._log[signs] += expected.log_likelihood(seen, variance)
                expected.learn(seen, variance)
        self._sure_once |= sure
        self._expected = self._expected or {signs: Expected(seen, variance) for signs in self._log}
        for signs, expected in self._expected.items():
            expected.move(np.array(signs) * (correction.dx_mm, correction.dtheta_deg))
        if causes := self.causes():
            raise Refusal("contradictory", f"the estimates contradict the moves: {'; or '.join(causes)}")

    def causes(self) -> list[str]:
        """The causes that explain the attempts, best first; none while a good cell explains them well enough."""
        best = max(self._log.values())
        if not best - self._log[1, 1] > ODDS:
            return []
        likely = sorted((signs for signs in WIRINGS if best - self._log[signs] < NAMED), key=lambda s: -self._log[s])
        return [WIRINGS[signs] for signs in likely]


def _density(off: Pair, variance: Pair) -> Pair:
    """Of a normal deviate, each axis for itself."""
    return np.asarray(np.exp(-0.5 * np.square(off) / variance) / np.sqrt(2.0 * np.pi * variance))


def turns_deg(both: PairObservation) -> tuple[float, float]:
    """How far either finger saw the object turn, clockwise in its picture; not finite where it saw none."""
    left, right = (math.degrees(finger.slip.angle_rad) for finger in both.fingers)
    return left, right


def mirrored(both: PairObservation) -> bool:
    """Whether both fingers see a turn of like size and the same sign; facing each other, they must see opposite ones.

    A turn that one finger alone sees says nothing: the other may have been let go, or be blind.
    """
    left, right = turns_deg(both)
    smaller, larger = sorted((abs(left), abs(right)))
    return left * right > 0.0 and larger > LEAST_TURN_DEG and LIKE * larger < smaller < math.inf
