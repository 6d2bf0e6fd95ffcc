"""A grid Bayes filter over the position error (x, theta) at the start of an insertion.

The moves between attempts are commands, hence known: the belief stays in coordinates of the first attempt's error, and
an attempt's evidence is evaluated at first error + sum of moves. Moves do not explain the creep of an object in the
hand each time it is blocked: its bottom moves outwards, which the filter expects before it is measured.

Two hypotheses compete, each with its own belief. Under "trusted" the networks' estimates hold with their stated spread.
Under "gain unknown" an estimate gives the side reliably but its size only up to a factor, as with an object held in a
way that the networks never saw. When an attempt contradicts the earlier ones, the weight shifts to "gain unknown", and
the search closes in on the side instead of swinging past it.
"""

import numpy as np

from service.contract.model_card import Expectations
from service.decision.evidence import Density, Evidence, Floats, Refusal
from service.decision.outline import YAW_SHARES, Outlines

HALF_RANGE = 22.0  # the grid covers +-22 mm and +-22 deg
CELL = 0.5
PRIOR_SOFTNESS = 0.6
SURE_INSERT = 0.95  # probability of insertion at zero error
SHORT_LEVER_MM, UNKNOWN_LEVER_MM = 30.0, 45.0
# Both networks see the same images, so their errors are correlated: each gets less than its full weight.
DIRECTION_WEIGHT, MAGNITUDE_WEIGHT = 0.3, 0.9
OUTLIER_SHARE = 0.02
DEFAULT_SIGMA = (3.5, 4.5)  # of a magnitude network without a sigma
USUAL = Expectations()
UNINFORMATIVE, FINEST = 100.0, 0.01  # mm and deg: a flat likelihood, and the finest that a half-millimetre grid needs
INCONSISTENT_BELOW = 0.05  # Bayes factor of all evidence so far against knowing nothing
RANGE = 15.0  # of the networks' training errors (mm and deg)
GAIN_UNKNOWN_SHARE = 0.2  # of insertions, a priori
GAIN_SPREAD = 0.8  # standard deviation of log(estimate / error) where the gain is unknown
GAIN_FROM_X_MM, GAIN_FROM_THETA_DEG = 2.0, 3.0  # errors below these have no meaningful ratio
_CANDIDATES = 4


def _sigmoid(value: Floats) -> Floats:
    return np.asarray(0.5 * (1.0 + np.tanh(0.5 * value)), np.float64)


def _blurred(distance: Floats, sigma: Floats) -> Floats:
    """[n, n]: probability of the row's cell when the column's has moved to ``distance`` from it, with spread sigma."""
    kernel = np.exp(np.maximum(-0.5 * (distance / sigma) ** 2, -80.0))  # no denormals: ten times slower
    return np.asarray(kernel / kernel.sum(0), np.float64)


def _shares() -> Floats:
    """Prior shares of the two hypotheses."""
    return np.array([1 - GAIN_UNKNOWN_SHARE, GAIN_UNKNOWN_SHARE])


def _near(values: Floats, tolerance: float, softness: float) -> Floats:
    return _sigmoid((tolerance - np.abs(values)) / softness)


def stated(evidence: Evidence, trained: tuple[float, float]) -> tuple[float, float]:
    """Sigma (mm, deg) of an attempt's pictures alone: the networks' own without their prior.

    A network states its posterior, which includes the spread of the errors it was ``trained`` on; the pictures'
    evidence is the posterior divided by that prior. An estimate that is no sharper than the prior carries none.
    """
    given = evidence.sigma or DEFAULT_SIGMA
    alone = (max(s, FINEST) ** -2 - spread**-2 for s, spread in zip(given, trained, strict=True))
    x_mm, theta_deg = (precision**-0.5 if precision > UNINFORMATIVE**-2 else UNINFORMATIVE for precision in alone)
    return x_mm, theta_deg


def _sign_membership(values: Floats, threshold: float, softness: float) -> Floats:
    """[3, n]: soft membership in the signs -1, 0, +1 around +-threshold."""
    positive, negative = _sigmoid((values - threshold) / softness), _sigmoid((-values - threshold) / softness)
    return np.stack([negative, np.clip(1 - positive - negative, 0, 1), positive])


class BeliefGrid:
    """Probability [89, 89] over the first error, and the sum of the moves made since.

    ``layers`` [2, 3, 89, 89] are the two hypotheses, trusted and gain unknown, each for every possible outline of the
    object; together they sum to 1. ``expected``: expectations of the networks that give the evidence. ``length_mm``:
    the object's length along the gap, see `Outlines`.
    """

    def __init__(
        self,
        grasp_height_mm: float | None = None,
        expected: Expectations = USUAL,
        length_mm: float | None = None,
    ) -> None:
        self._expected = expected
        self._cells = np.arange(-HALF_RANGE, HALF_RANGE + CELL / 2, CELL)
        edges = [_near(self._cells, edge, PRIOR_SOFTNESS) for edge in expected.edge]
        self._prior = np.outer(*edges) / (edges[0].sum() * edges[1].sum())
        self._outlines = Outlines(self._cells, expected.tolerance, length_mm)
        outline = np.full(len(YAW_SHARES), 1 / len(YAW_SHARES))
        self.layers: Floats = _shares()[:, None, None, None] * outline[:, None, None] * self._prior
        self.offset = np.zeros(2)
        self._lever_mm = max(0.0, (grasp_height_mm or UNKNOWN_LEVER_MM) - SHORT_LEVER_MM)
        self._turned = _blurred(self._cells[:, None] - self._cells, np.array(expected.creep_theta_deg))

    @property
    def probability(self) -> Floats:
        """[89, 89], sums to 1: all hypotheses together."""
        return np.asarray(self.layers.sum((0, 1)), np.float64)

    @property
    def trust(self) -> float:
        """Probability that the networks' estimates hold with their stated spread."""
        return float(self.layers[0].sum())

    @property
    def current_x_mm(self) -> Floats:
        """The x error of each row now."""
        return np.asarray(self._cells + self.offset[0], np.float64)

    @property
    def current_theta_deg(self) -> Floats:
        """The yaw error of each column now."""
        return np.asarray(self._cells + self.offset[1], np.float64)

    def move(self, dx_mm: float, dtheta_deg: float) -> None:
        """Apply a correction's move; raises Refusal on a move that is not finite."""
        if not np.isfinite([dx_mm, dtheta_deg]).all():
            raise Refusal("non_finite", f"the belief was told a move of ({dx_mm} mm, {dtheta_deg} deg)")
        self.offset += (dx_mm, dtheta_deg)

    def creep(self) -> None:
        """Account for a blocked attempt: the object has turned in the hand, bottom outwards, before the next move."""
        x_mm, expected = self.current_x_mm, self._expected
        near = _sigmoid((expected.near_mm - np.abs(x_mm)) / 0.8)
        near_mm = expected.creep_near_mm + expected.creep_near_mm_per_mm * self._lever_mm
        outwards = (expected.creep_mm + near * (near_mm - expected.creep_mm)) * np.tanh(x_mm / 0.7)
        spread = expected.creep_spread_mm + expected.creep_near_more_mm * near
        crept = _blurred(self._cells[:, None] - (self._cells + outwards), spread)
        self.layers = (crept @ self.layers) @ self._turned.T

    def absorb_failure(self) -> None:
        """Account for a failure at the current pose: the error is not near zero."""
        inserts = self._outlines.chances(self.current_x_mm, self.current_theta_deg)
        self._normalise(self.layers * (1 - SURE_INSERT * inserts))

    def absorb(self, evidence: Evidence) -> bool:
        """Multiply in a failed attempt and its evidence; on contradiction restart from it and return False."""
        self.absorb_failure()
        likelihood = np.stack([self.likelihood(evidence), self._gain_unknown_likelihood(evidence)])[:, None]
        outline = self.layers.sum((0, 2, 3))[:, None, None]  # the outline learnt from failures stays
        wide = _shares()[:, None, None, None] * outline * (self._prior + 1e-3 * self._prior.max())
        if float((self.layers * likelihood).sum()) < INCONSISTENT_BELOW * float((wide * likelihood).sum()):
            self._normalise(wide * likelihood)
            return False
        self._normalise(self.layers * likelihood)
        return True

    def likelihood(self, evidence: Evidence) -> Floats:
        """[89, 89], the estimate's density over (mm, deg): how well each first error explains it."""
        if evidence.density is not None:
            return self._density_likelihood(evidence.density)
        return np.asarray(
            self._direction_likelihood(evidence) ** DIRECTION_WEIGHT
            * self._magnitude_likelihood(evidence) ** MAGNITUDE_WEIGHT,
            np.float64,
        )

    def _gain_unknown_likelihood(self, evidence: Evidence) -> Floats:
        """The same if an estimate is the error times an unknown factor, drawn anew in each attempt."""
        parts = []
        for cells, estimate, sigma, start in zip(
            (self.current_x_mm, self.current_theta_deg),
            evidence.error,
            stated(evidence, self._expected.spread),
            (GAIN_FROM_X_MM, GAIN_FROM_THETA_DEG),
            strict=True,
        ):
            unit = np.hypot(estimate, start)
            spread = np.hypot(GAIN_SPREAD, sigma / unit)  # never more certain than the networks
            off = (np.arcsinh(estimate / start) - np.arcsinh(cells / start)) / spread
            density = np.exp(-0.5 * off**2) / (np.sqrt(2 * np.pi) * spread * unit)
            parts.append((1 - OUTLIER_SHARE) * density + OUTLIER_SHARE / (2 * RANGE))
        return np.asarray(np.outer(*parts), np.float64)

    def _direction_likelihood(self, evidence: Evidence) -> Floats:
        t_x, t_theta = evidence.threshold_x_mm, evidence.threshold_theta_deg
        share_x = np.array([RANGE - t_x, 2 * t_x, RANGE - t_x]) / (2 * RANGE)
        share_theta = np.array([RANGE - t_theta, 2 * t_theta, RANGE - t_theta]) / (2 * RANGE)
        table = np.zeros((3, 3))
        for entry, probability in zip(evidence.classes, evidence.probabilities, strict=True):
            table[entry.sign_x + 1, entry.sign_theta + 1] = probability
        # The networks give P(class | images); dividing by the class's share of the training errors leaves likelihood.
        table /= np.outer(share_x, share_theta)
        table = (1 - OUTLIER_SHARE) * table + OUTLIER_SHARE
        x_part = _sign_membership(self.current_x_mm, t_x, 0.5)
        theta_part = _sign_membership(self.current_theta_deg, t_theta, 1.0)
        return np.asarray(x_part.T @ table @ theta_part, np.float64)

    def _magnitude_likelihood(self, evidence: Evidence) -> Floats:
        sigma = stated(evidence, self._expected.spread)
        peaks = [
            np.exp(-0.5 * ((cells - centre) / width) ** 2)
            for cells, centre, width in zip(
                (self.current_x_mm, self.current_theta_deg), evidence.error, sigma, strict=True
            )
        ]
        # An outlier may be anywhere in the range.
        density = np.outer(*peaks) / (2 * np.pi * sigma[0] * sigma[1])
        return np.asarray((1 - OUTLIER_SHARE) * density + OUTLIER_SHARE / (2 * RANGE) ** 2, np.float64)

    def _density_likelihood(self, density: Density) -> Floats:
        peak = np.exp(density.log_density - density.log_density.max())
        along_x = np.stack([np.interp(self.current_x_mm, density.x_mm, column) for column in peak.T], axis=1)
        both = np.stack([np.interp(self.current_theta_deg, density.theta_deg, row) for row in along_x])
        both /= peak.sum() * np.diff(density.x_mm).mean() * np.diff(density.theta_deg).mean()
        return np.asarray((1 - OUTLIER_SHARE) * both + OUTLIER_SHARE / (2 * RANGE) ** 2, np.float64)

    def best_move(self) -> tuple[tuple[float, float], float]:
        """The move ((mm, deg), probability that the next attempt inserts) with the fewest expected trials.

        The bound: 1 + P(next misses) (1 + P(the one after misses | the next one shows only its failure)).
        """
        by_outline = self.layers.sum(0)
        hits = self._outlines.hits(by_outline)
        row, column = self._fewest_trials(by_outline, hits)
        target = self._refined(by_outline, row, column)
        return (-target[0] - float(self.offset[0]), -target[1] - float(self.offset[1])), float(hits[row, column])

    def _fewest_trials(self, by_outline: Floats, hits: Floats) -> tuple[int, int]:
        """The candidate with the least bound. No second attempt beats the best first one, so most are skipped."""
        candidates = _peaks(hits)
        best, least = candidates[0], np.inf
        for row, column in candidates:
            if 3 - SURE_INSERT * (2 * float(hits[row, column]) + float(hits.max())) >= least:
                break  # no later candidate is better
            cost = self._two_step_cost(by_outline, hits, row, column)
            if cost < least:
                best, least = (row, column), cost
        return best

    def _aimed(self, row: int, column: int) -> Floats:
        """[3, 89, 89]: chance of each outline to enter when aimed at this cell, for each error."""
        return self._outlines.chances(self._cells - self._cells[row], self._cells - self._cells[column])

    def _two_step_cost(self, by_outline: Floats, hits: Floats, row: int, column: int) -> float:
        missed = by_outline * (1 - SURE_INSERT * self._aimed(row, column))
        second = float(self._outlines.hits(missed).max())
        miss = 1 - SURE_INSERT * float(hits[row, column])
        return 1 + miss + (miss - SURE_INSERT * second)

    def _refined(self, by_outline: Floats, row: int, column: int) -> tuple[float, float]:
        """Centre of mass of the belief inside the aimed tolerance: finer than a cell."""
        inside = (by_outline * self._aimed(row, column)).sum(0)
        total = inside.sum()
        return float(inside.sum(1) @ self._cells / total), float(inside.sum(0) @ self._cells / total)

    def enters(self) -> float:
        """Probability that an attempt from the object's present pose inserts."""
        chances = self._outlines.chances(self.current_x_mm, self.current_theta_deg)
        return SURE_INSERT * float((self.layers.sum(0) * chances).sum())

    def moments(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Mean and standard deviation of the current error, (mm, deg) each."""
        probability = self.probability
        rows, columns = probability.sum(1), probability.sum(0)
        mean = float(rows @ self.current_x_mm), float(columns @ self.current_theta_deg)
        spread = (
            float(np.sqrt(rows @ (self.current_x_mm - mean[0]) ** 2)),
            float(np.sqrt(columns @ (self.current_theta_deg - mean[1]) ** 2)),
        )
        return mean, spread

    def _normalise(self, weights: Floats) -> None:
        self.layers = np.asarray(weights / weights.sum(), np.float64)


def _peaks(hits: Floats) -> list[tuple[int, int]]:
    """The best cells, each outside the neighbourhood (4 mm, 6 deg) of the better ones."""
    remaining = hits.copy()
    peaks: list[tuple[int, int]] = []
    for _ in range(_CANDIDATES):
        row, column = np.unravel_index(int(np.argmax(remaining)), remaining.shape)
        peaks.append((int(row), int(column)))
        remaining[max(0, row - 8) : row + 9, max(0, column - 12) : column + 13] = -1
    return peaks
