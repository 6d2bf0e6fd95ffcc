"""Whether the estimates of an insertion follow from the moves commanded between them.

A miswired cell on its first day answers a good correction with a larger error, or with one outside the networks' range.
A Bayes filter therefore follows the error through the attempts: once with the moves as commanded, and once with x, yaw
or both reversed. The wiring that predicted the estimates best is the likeliest. A mirrored picture is detected sooner:
both fingers see the object turn from opposite sides, but a mirrored one sees it from the same side.

What matters is how the networks read an error, see `reading`. In drawn cells they determine the side, and hardly the
size.
"""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from service.contract.wire import Correction, Estimate
from service.contract.words.wiring import WIRINGS
from service.decision.evidence import Refusal
from service.perception.observation import PairObservation

Pair = NDArray[np.float64]  # x mm, theta deg
Floats = NDArray[np.float64]
Signs = tuple[int, int]

ODDS = math.log(20.0)  # odds required of a reversed cell against a good one
NAMED = math.log(5.0)  # causes up to this much worse than the best one are named, too
CELLS = np.arange(-18.0, 18.5)  # errors of the first attempt, mm and deg
USUAL, WIDE_SHARE = 15.0, 0.05  # larger ones are rarer: a wide object may start 18 mm off, none with a larger yaw
SIDE = np.array([1.0, 3.0])  # at twice this error the estimate is on its side
MIDDLE = 7.5  # mean training error on one side
SPREAD = 8.7  # one sigma of all training errors
NOISE_SHARE, NOISE = 0.75, np.array([1.0, 1.5])  # noise of an estimate: share of its stated sigma, and a constant
WALK = np.array([1.5, 2.0])  # one sigma added by a correction
UNKNOWN = np.array([50.0, 50.0])  # one sigma of an estimate without one
OUTLIERS, RANGE = 0.02, 40.0
FAR = np.array([15.0, 14.0])  # beyond, the networks often answer with almost no error
FAR_OUTLIERS, FAR_SIGMA = 0.3, 4.0
SURE = np.array([2.2, 5.0])  # one sigma. Networks once this certain are seldom in doubt later, except far off
SURE_SHARE, FAR_SURE_SHARE = 0.85, 0.35
CHECKED_N = 8  # attempts; later ones only show whether a picture is mirrored
TURN_DEG, LIKE = 0.2, 0.5  # least larger turn, and least share of the smaller one, of a turn seen by both
CLEAR_TURN_DEG, CLEARLY_LIKE = 1.0, 0.7
ONE_SIDED = 2  # turns seen from the same side that refuse a cell; a clear one counts twice
_STARTS = np.outer(np.where(np.abs(CELLS) <= USUAL, 1.0, WIDE_SHARE), np.abs(CELLS) <= USUAL)
_STARTS /= _STARTS.sum()
_BLUR = np.exp(-0.5 * np.square((CELLS[:, None] - CELLS) / WALK[:, None, None]))
_BLUR /= _BLUR.sum(axis=1, keepdims=True)


def reading(error: Floats, sigma: float, side: float) -> Floats:
    """Mean estimate of the networks for errors [n], mm or deg, when it comes with this sigma.

    Networks that see only the side answer with its middle and a sigma of half the spread; networks that see nothing
    answer with 0. ``side``: of `SIDE`.
    """
    only_side = min(1.0, 2.0 * sigma / SPREAD)
    known = max(0.0, 1.0 - (sigma / SPREAD) ** 2) / 0.75 if sigma > 0.5 * SPREAD else 1.0
    return known * ((1.0 - only_side) * error + only_side * MIDDLE * np.tanh(error / side))


class Followed:
    """The error of the first attempt under one wiring: ``weights`` [n, n] over x and yaw, and its evidence.

    ``log_evidence``: the logarithm of the probability of all estimates so far.
    """

    def __init__(self, signs: Signs) -> None:
        self.signs = np.array(signs)
        self.moved: Pair = np.zeros(2)
        self.weights: Floats = _STARTS
        self.log_evidence = 0.0

    def learn(self, estimate: Pair, sigma: Pair, *, sure: bool, sure_once: bool) -> None:
        """Add an estimate, and whether networks that were ``sure_once`` are still sure."""
        here = [CELLS + moved for moved in self.moved]
        far = np.logical_or.outer(np.abs(here[0]) > FAR[0], np.abs(here[1]) > FAR[1])
        near = [_near(*axis) for axis in zip(here, estimate, sigma, SIDE, NOISE, strict=True)]
        likelihood = np.where(far, math.prod(map(_far, estimate, sigma)), np.outer(*near))
        if sure_once:
            share = np.where(far, FAR_SURE_SHARE, SURE_SHARE)
            likelihood = likelihood * (share if sure else 1.0 - share)
        weights = self.weights * likelihood
        self.log_evidence += math.log(weights.sum())
        self.weights = weights / weights.sum()

    def move(self, command: Pair) -> None:
        self.moved = self.moved + self.signs * command
        self.weights = _BLUR[0] @ self.weights @ _BLUR[1].T


def _density(off: Floats, sigma: float) -> Floats:
    """Density of a normal deviate."""
    return np.asarray(np.exp(-0.5 * np.square(off / sigma)) / (math.sqrt(2.0 * math.pi) * sigma))


def _near(error: Floats, estimate: float, sigma: float, side: float, noise: float) -> Floats:
    """[n]: density of an estimate for errors [n] in the networks' range; an outlier may be anywhere."""
    off = estimate - reading(error, sigma, side)
    return (1.0 - OUTLIERS) * _density(off, math.hypot(NOISE_SHARE * sigma, noise)) + OUTLIERS / RANGE


def _far(estimate: float, sigma: float) -> float:
    """Density of an estimate for an error beyond that range."""
    stray = _density(np.array(estimate), math.hypot(FAR_SIGMA, sigma))
    return float((1.0 - FAR_OUTLIERS) * stray + FAR_OUTLIERS / RANGE)


@dataclass(slots=True)
class Consistency:
    """Likelihoods of all possible wirings of a cell from the attempts so far."""

    _followed: dict[Signs, Followed] = field(
        default_factory=lambda: {signs: Followed(signs) for signs in [(1, 1), *WIRINGS]}
    )
    _sure_once: bool = False
    _attempts_n: int = 0
    _one_sided: int = 0

    def add(self, estimate: Estimate, both: PairObservation) -> None:
        """Add an attempt's estimate and last pair. Raises Refusal that names the likely causes."""
        self.add_sides(both)
        self._attempts_n += 1
        if self._attempts_n > CHECKED_N:
            return
        measured = np.array([estimate.dx_mm, estimate.dtheta_deg])
        sigma = np.array([estimate.sigma_x_mm or UNKNOWN[0], estimate.sigma_theta_deg or UNKNOWN[1]])
        sure = bool((sigma < SURE).all())
        for followed in self._followed.values():
            followed.learn(measured, sigma, sure=sure, sure_once=self._sure_once)
        self._sure_once |= sure
        if causes := self.causes():
            raise Refusal("contradictory", f"the estimates contradict the moves: {'; or '.join(causes)}")

    def move(self, correction: Correction) -> None:
        """Follow the move that answers the attempt added last."""
        for followed in self._followed.values():
            followed.move(np.array([correction.dx_mm, correction.dtheta_deg]))

    def add_sides(self, both: PairObservation) -> None:
        """Add the last pair of an attempt, decided or not. Raises Refusal where one picture is mirrored."""
        self._one_sided = max(0, self._one_sided + one_sided(both))
        if self._one_sided >= ONE_SIDED:
            raise Refusal("contradictory", "both fingers see the object turn the same way: one picture is mirrored")

    def causes(self) -> list[str]:
        """The causes that explain the attempts, best first; empty while a good cell explains them well enough."""
        log = {signs: followed.log_evidence for signs, followed in self._followed.items()}
        best = max(log.values())
        if not best - log[1, 1] > ODDS:
            return []
        likely = sorted((signs for signs in WIRINGS if best - log[signs] < NAMED), key=lambda signs: -log[signs])
        return [WIRINGS[signs] for signs in likely]


def turns_deg(both: PairObservation) -> tuple[float, float]:
    """Turn of the object as seen by each finger, clockwise in its picture; not finite where it saw none."""
    left, right = (math.degrees(finger.slip.angle_rad) for finger in both.fingers)
    return left, right


def one_sided(both: PairObservation) -> int:
    """Both fingers saw a turn from the same side: 1, clearly so: 2; from opposite sides, as they must: -1; else 0.

    A turn that only one finger sees means nothing: the other may have lost contact, or sight.
    """
    left, right = turns_deg(both)
    smaller, larger = sorted((abs(left), abs(right)))
    if not (larger > TURN_DEG and LIKE * larger < smaller < math.inf):
        return 0
    if left * right < 0.0:
        return -1
    return 2 if larger > CLEAR_TURN_DEG and CLEARLY_LIKE * larger < smaller else 1
