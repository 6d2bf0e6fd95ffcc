"""Which of two versions is better, by bets that are fair where it is not.

A bet is against a claim, "on the mean this gain is not above 0". It begins with 1, and each insertion stakes a share of
it. Where the claim holds, whatever came before, the capital ever reaches 20 with a probability of at most 1/20 (Ville
1939; Waudby-Smith and Ramdas 2024, *Estimating means of bounded random variables by betting*). So one may look after
each insertion, for as long as one likes. Of several shares that could be staked each gets a part, and a part of all
waits for each later insertion: what was right for a thousand may still turn.
"""

import math
from typing import Literal

import numpy as np
from pydantic import Field

from service.contract.frames import Contract
from service.contract.wire import Arm
from service.decision.belief import USUAL, BeliefGrid
from service.decision.evidence import Evidence
from service.decision.models import ModelSet

ENOUGH = 20.0  # the capital from which on a claim counts as refuted
STAKES = (0.1, 0.3, 0.6, 0.9)
LEAST_COVERAGE = 0.75  # of 90 % intervals, against what is known to within what fits the gap
TOLERATED = 0.1  # of insertions that fail; twice as many as with the version before, if that is more
SPAN = 30.0  # of the errors at the start, mm and deg
FLAT = 4.0 * USUAL.tolerance[0] * USUAL.tolerance[1] / SPAN**2  # what knowing nothing gives to where the error was
FLOOR = 0.05  # of that is the least that a version is taken to have given
WORST = -math.log(FLOOR * FLAT)

Role = Literal["shadow", "previous"]
Held = tuple[bool | None, bool | None]


class Bet(Contract):
    """``capital`` at stake by share, apart from what waits; ``taken_n`` gains were bet on."""

    taken_n: int = 0
    capital: tuple[float, ...] = (0.0,) * len(STAKES)

    @property
    def worth(self) -> float:
        """All that it has, 1 at the start."""
        return math.fsum(self.capital) / len(STAKES) + 1.0 / (self.taken_n + 1)

    def on(self, gain: float) -> "Bet":
        """After a gain of -1 or more."""
        fresh = 1.0 / ((self.taken_n + 1) * (self.taken_n + 2))
        pairs = zip(self.capital, STAKES, strict=True)
        capital = tuple((have + fresh) * (1.0 + share * gain) for have, share in pairs)
        return Bet(taken_n=self.taken_n + 1, capital=capital)

    def that(self, happened: bool | None, rate: float) -> "Bet":
        """After something that was to happen more often than ``rate`` did or did not; None: nobody knows."""
        return self if happened is None else self.on((happened - rate) / rate)


class Contest(Contract):
    """What speaks for a version beside the active one, after ``scored_n`` insertions that went in.

    ``score``: it foretells the first error better. ``covers``: its intervals hold enough, of x and of yaw. ``misses``:
    those of the active one do not. ``fails``: more insertions fail than ``tolerated``.
    """

    scored_n: int = 0
    ended_n: int = 0
    failed_n: int = 0
    tolerated: float = Field(default=TOLERATED, gt=0.0, lt=1.0)
    score: Bet = Bet()
    covers: tuple[Bet, Bet] = (Bet(), Bet())
    misses: tuple[Bet, Bet] = (Bet(), Bet())
    fails: Bet = Bet()

    def worth(self, role: Role) -> float:
        """What speaks for deciding with it: of a shadow the weakest of all that has to be shown, else the mean.

        The version before decides again where any of what may be wrong with the active one is.
        """
        if role == "shadow":
            return min(bet.worth for bet in (self.score, *self.covers))
        return math.fsum(bet.worth for bet in self._doubts.values()) / len(self._doubts)

    def because(self, role: Role) -> str:
        """What speaks for it most, in words."""
        if role == "shadow":
            return "it foretells errors better, and its intervals hold them"
        return max(self._doubts, key=lambda doubt: self._doubts[doubt].worth)

    @property
    def _doubts(self) -> dict[str, Bet]:
        return {
            "the version before foretells errors better": self.score,
            "the intervals of x hold too few errors": self.misses[0],
            "the intervals of yaw hold too few errors": self.misses[1],
            "more insertions fail than before": self.fails,
        }

    @property
    def tolerates(self) -> float:
        """The share of failures to tolerate of a version that takes over."""
        return min(0.9, max(TOLERATED, 2.0 * self.failed_n / max(1, self.ended_n)))

    def ended(self, *, failed: bool) -> "Contest":
        """An insertion ended, inserted or for a reason that its decisions may have."""
        counted = {"ended_n": self.ended_n + 1, "failed_n": self.failed_n + failed}
        return self.model_copy(update=counted | {"fails": self.fails.that(failed, self.tolerated)})

    def scored(self, better: float, held: Held, active_held: Held) -> "Contest":
        """An insertion went in: ``better`` is the difference of the scores, ``held`` as :func:`held` has it."""
        covers = tuple(bet.that(one, LEAST_COVERAGE) for bet, one in zip(self.covers, held, strict=True))
        missed = tuple(None if one is None else not one for one in active_held)
        misses = tuple(bet.that(one, 1.0 - LEAST_COVERAGE) for bet, one in zip(self.misses, missed, strict=True))
        done = {"scored_n": self.scored_n + 1, "score": self.score.on(better / WORST)}
        return self.model_copy(update=done | {"covers": covers, "misses": misses})


def log_score(models: ModelSet, evidence: Evidence | None, arm: Arm, error: tuple[float, float]) -> float:
    """From -WORST to 0: the log of the probability that a belief on this evidence gives to where ``error`` may lie.

    That is within what fits the gap. None stands for a refusal: the belief knows that the attempt was blocked.
    """
    grid = BeliefGrid(arm.grasp_height_mm, models.card.expectations, arm.gripper_width_mm)
    if evidence is None:
        grid.absorb_failure()
    else:
        grid.absorb(evidence)
    near_x = np.abs(grid.current_x_mm - error[0]) <= USUAL.tolerance[0]
    near_theta = np.abs(grid.current_theta_deg - error[1]) <= USUAL.tolerance[1]
    mass = float(grid.probability[np.ix_(near_x, near_theta)].sum())
    return math.log((1.0 - FLOOR) * mass + FLOOR * FLAT)


def held(evidence: Evidence | None, error: tuple[float, float]) -> Held:
    """Whether the 90 % intervals of x and of yaw hold the error, None where there are none."""
    if evidence is None or evidence.sigma is None:
        return None, None
    estimate = evidence.estimate()
    sides = zip((estimate.interval_x_mm, estimate.interval_theta_deg), error, strict=True)
    x, theta = (None if interval is None else interval[0] <= at <= interval[1] for interval, at in sides)
    return x, theta
