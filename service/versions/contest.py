"""Which of two versions is better, by bets that are fair where it is not.

A bet is against a claim, "on the mean this gain is not above 0". It begins with 1, and each insertion stakes a share of
it. Where the claim holds, whatever came before, the capital ever reaches 20 with a probability of at most 1/20 (Ville
1939; Waudby-Smith and Ramdas 2024, *Estimating means of bounded random variables by betting*). So one may look after
each insertion, for as long as one likes. Of several shares that could be staked each gets a part, and a part of all
waits for each later insertion: what was right for a thousand may still turn.
"""

import math
from typing import Literal, Self

from pydantic import Field

from service.contract.frames import Contract
from service.contract.wire import MAX_ATTEMPTS
from service.decision.evidence import Evidence

ENOUGH = 20.0  # the capital from which on a claim counts as refuted
STAKES = (0.1, 0.3, 0.6, 0.9)
LEAST_COVERAGE = 0.75  # of 90 % intervals, against what is known to within what fits the gap
TOLERATED = 1.1  # times as many attempts as with the version before
KNOWN_N, UNKNOWN = 50, 5.0  # insertions from which on that is known, and attempts that are tolerated where it is not
FAILED = MAX_ATTEMPTS + 1  # attempts that a failure counts as
SUREST = 0.98  # that a version is taken to have been of how an attempt ends
WORST = -math.log(1.0 - SUREST)

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
    """What speaks for a version beside the active one, after ``scored_n`` attempts that both had foretold.

    ``score``: it foretells better which attempts go in. ``covers``: its intervals hold enough, of x and of yaw.
    ``misses``: those of the active one do not. ``slow``: that one takes more attempts than ``tolerated``.
    """

    scored_n: int = 0
    ended_n: int = 0
    attempts_n: int = 0
    tolerated: float = Field(default=UNKNOWN, ge=1.0)
    score: Bet = Bet()
    covers: tuple[Bet, Bet] = (Bet(), Bet())
    misses: tuple[Bet, Bet] = (Bet(), Bet())
    slow: Bet = Bet()

    def worth(self, role: Role) -> float:
        """What speaks for deciding with it: of a shadow the weakest of all that has to be shown, else the mean.

        The version before decides again where any of what may be wrong with the active one is.
        """
        if role == "shadow":
            return min(bet.worth for bet in (self.score, *self.covers))
        return math.fsum(bet.worth for bet in self._doubts.values()) / len(self._doubts)

    def because(self, role: Role) -> str:
        if role == "shadow":
            return "it foretells better what goes in, and its intervals hold"
        return max(self._doubts, key=lambda doubt: self._doubts[doubt].worth)

    @property
    def _doubts(self) -> dict[str, Bet]:
        return {
            "the version before foretells better what goes in": self.score,
            "the intervals of x hold too few errors": self.misses[0],
            "the intervals of yaw hold too few errors": self.misses[1],
            "more attempts are needed than before": self.slow,
        }

    @property
    def tolerates(self) -> float:
        """The mean of attempts to tolerate of a version that takes over."""
        return TOLERATED * self.attempts_n / self.ended_n if self.ended_n >= KNOWN_N else UNKNOWN

    def ended(self, attempts: int) -> Self:
        """An insertion ended after so many attempts, `FAILED` where it failed for a reason that decisions may have."""
        counted = {"ended_n": self.ended_n + 1, "attempts_n": self.attempts_n + attempts}
        slow = self.slow.on((attempts - self.tolerated) / self.tolerated)
        return self.model_copy(update=counted | {"slow": slow})

    def scored(self, better: float) -> Self:
        """An attempt has come out: ``better`` is the difference of the scores of what was foretold."""
        return self.model_copy(update={"scored_n": self.scored_n + 1, "score": self.score.on(better / WORST)})

    def held(self, held: Held, active_held: Held) -> Self:
        """An insertion went in, and its first error is known."""
        covers = tuple(bet.that(one, LEAST_COVERAGE) for bet, one in zip(self.covers, held, strict=True))
        missed = tuple(None if one is None else not one for one in active_held)
        misses = tuple(bet.that(one, 1.0 - LEAST_COVERAGE) for bet, one in zip(self.misses, missed, strict=True))
        return self.model_copy(update={"covers": covers, "misses": misses})


def log_score(chance: float, *, inserted: bool) -> float:
    """Of a ``chance`` that an attempt goes in, once it has come out: from -WORST to about 0."""
    chance = min(SUREST, max(1.0 - SUREST, chance))
    return math.log(chance if inserted else 1.0 - chance)


def intervals_hold(evidence: Evidence | None, error: tuple[float, float]) -> Held:
    """Whether the 90 % intervals of x and of yaw hold the error, None where there are none."""
    if evidence is None or evidence.sigma is None:
        return None, None
    estimate = evidence.estimate()
    sides = zip((estimate.interval_x_mm, estimate.interval_theta_deg), error, strict=True)
    x, theta = (None if interval is None else interval[0] <= at <= interval[1] for interval, at in sides)
    return x, theta
