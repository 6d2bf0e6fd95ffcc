"""Whether the estimates of an insertion follow from the moves that were commanded between them.

A cell that is wired wrong on its first day answers a good correction with a larger error, or with one out of the range
that the networks know. So after each blocked attempt, the estimate is compared with what the one before and the
correction in between predict, once as commanded and once with x, yaw or both reversed. A picture that is mirrored shows
itself at once: both fingers see the object turn from opposite sides, a mirrored one from the same side.

The constants were fitted on 280 insertions in good cells and 161 in reversed ones (simulated, released networks).
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

ODDS = math.log(100.0)  # that a reversed cell must have against a good one; good ones reached 30 at most
NAMED = math.log(20.0)  # causes that explain it this much worse than the best one are named, too
SURE = np.array([2.2, 5.0])  # one sigma; an estimate with more says no more than that it does not know
FAR = np.array([15.0, 14.0])  # from here on the networks often do not know
FITS = np.array([3.0, 4.0])  # such an error is often within the gap's clearance, and then not blocked
SURE_SHARE, FAR_SURE_SHARE, FITS_BLOCKED = 0.93, 0.35, 0.4
MODEL_SIGMA = np.array([1.0, 2.0])  # beyond what the networks say of themselves
WALK_SIGMA = np.array([0.7, 1.0])  # that an attempt without a sure estimate adds
OUTLIERS, FAR_OUTLIERS, RANGE = 0.15, 0.7, 40.0
LEAST_TURN_DEG, LIKE = 1.0, 0.5  # the smaller turn is at least this share of the larger


@dataclass(slots=True)
class Consistency:
    """The log-likelihood of each way that a cell may be wired, given the attempts so far."""

    _log: dict[tuple[int, int], float] = field(default_factory=lambda: dict.fromkeys([(1, 1), *WIRINGS], 0.0))
    _predicted: dict[tuple[int, int], Pair] = field(default_factory=dict)
    _variance: Pair = field(default_factory=lambda: np.zeros(2))

    def add(self, correction: Correction, both: PairObservation) -> None:
        """Take in an attempt's correction and last pair. Raises Refusal that names the likely causes."""
        if mirrored(both):
            raise Refusal("contradictory", "both fingers see the object turn the same way: one picture is mirrored")
        estimate = correction.estimate
        here = np.array([estimate.dx_mm, estimate.dtheta_deg])
        sigma = np.array([estimate.sigma_x_mm or math.inf, estimate.sigma_theta_deg or math.inf])
        sure = bool((sigma < SURE).all())
        for signs, predicted in self._predicted.items():
            self._log[signs] += self._likelihood(predicted, here, sigma, sure=sure)
        self._walk(np.array([correction.dx_mm, correction.dtheta_deg]), here, sigma, sure=sure)
        if causes := self.causes():
            raise Refusal("contradictory", f"the estimates contradict the moves: {'; or '.join(causes)}")

    def _likelihood(self, predicted: Pair, here: Pair, sigma: Pair, *, sure: bool) -> float:
        far = bool((np.abs(predicted) > FAR).any())
        share = FAR_SURE_SHARE if far else SURE_SHARE
        log = math.log(share if sure else 1.0 - share)
        if (np.abs(predicted) < FITS).all():
            log += math.log(FITS_BLOCKED)
        if sure:
            spread = np.sqrt(self._variance + np.square(sigma) + np.square(MODEL_SIGMA))
            log += _log_density((here - predicted) / spread, spread, FAR_OUTLIERS if far else OUTLIERS)
        return log

    def _walk(self, command: Pair, here: Pair, sigma: Pair, *, sure: bool) -> None:
        """What each wiring predicts of the next attempt; nothing before the first sure estimate."""
        if sure:
            self._predicted = {signs: here + np.array(signs) * command for signs in self._log}
            self._variance = np.square(sigma)
        else:
            self._predicted = {signs: there + np.array(signs) * command for signs, there in self._predicted.items()}
            self._variance = self._variance + np.square(WALK_SIGMA)

    def causes(self) -> list[str]:
        """The causes that explain the attempts, best first; none while a good cell explains them well enough."""
        best = max(self._log.values())
        if not best - self._log[1, 1] > ODDS:
            return []
        likely = sorted((signs for signs in WIRINGS if best - self._log[signs] < NAMED), key=lambda s: -self._log[s])
        return [WIRINGS[signs] for signs in likely]


def _log_density(z: Pair, spread: Pair, outliers: float) -> float:
    """Of both axes together; an outlier may be anywhere in the range."""
    density = np.exp(-0.5 * np.square(z)) / (spread * math.sqrt(2.0 * math.pi))
    return float(np.log((1.0 - outliers) * density + outliers / RANGE).sum())


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
