"""Which of two versions is better, by bets that are fair if it is not.

A bet is against a claim, "on average this gain is not above 0". Its capital begins at 1, and each insertion stakes a
share of it. If the claim is true, whatever came before, the capital ever reaches 20 with a probability of at most 1/20
(Ville 1939; Waudby-Smith and Ramdas 2024, *Estimating means of bounded random variables by betting*). One may therefore
look after each insertion, for as long as one likes. The capital is split over several possible shares, and a part is
reserved for each later insertion, because the result of a thousand may still change.
"""

import math
from typing import Literal, Self

from pydantic import Field

from service.contract.frames import Contract
from service.contract.wire import MAX_ATTEMPTS
from service.decision.evidence import Evidence

ENOUGH = 20.0  # the capital at which a claim counts as refuted
MOST = 1e9  # of a capital; a bet won for thousands of insertions would overflow
STAKES = (0.1, 0.3, 0.6, 0.9)
LEAST_COVERAGE = 0.75  # of 90 % intervals, with errors known to within the gap's clearance
TOLERATED = 1.1  # ratio to the attempts with the version before
KNOWN_N, UNKNOWN = 150, 5.0  # insertions of an object after which that mean is known, and the attempts tolerated before
SOME_N = 30  # insertions after which an object that needs more attempts than that is allowed them
OBJECTS_N = 32  # whose insertions are counted apart
FAILED = MAX_ATTEMPTS + 1  # number of attempts that a failure counts as
SUREST = 0.98  # highest confidence attributed to a version about the end of an attempt
WORST = -math.log(1.0 - SUREST)

Role = Literal["shadow", "previous"]
Held = tuple[bool | None, bool | None]


class Bet(Contract):
    """``capital`` at stake by share, without the reserve; ``taken_n`` gains were bet on."""

    taken_n: int = 0
    capital: tuple[float, ...] = (0.0,) * len(STAKES)

    @property
    def worth(self) -> float:
        """Total capital, 1 at the start."""
        return math.fsum(self.capital) / len(STAKES) + 1.0 / (self.taken_n + 1)

    def on(self, gain: float) -> "Bet":
        """After a gain of -1 or more."""
        fresh = 1.0 / ((self.taken_n + 1) * (self.taken_n + 2))
        pairs = zip(self.capital, STAKES, strict=True)
        capital = tuple(min(MOST, (have + fresh) * (1.0 + share * gain)) for have, share in pairs)
        return Bet(taken_n=self.taken_n + 1, capital=capital)

    def that(self, happened: bool | None, rate: float) -> "Bet":
        """After an event claimed to be more frequent than ``rate`` has happened or not; None: unknown."""
        return self if happened is None else self.on((happened - rate) / rate)


class Contest(Contract):
    """Evidence for a version beside the active one, after ``scored_n`` attempts that both had predicted.

    ``score``: it predicts better which attempts insert. ``covers``: its intervals hold enough, of x and of yaw.
    ``misses``: those of the active one do not. ``slow``: the active one takes more attempts than ``tolerated_of`` the
    object, or of one that is not listed there, than ``tolerated`` and `UNKNOWN`. ``by_object``: insertions, attempts.
    """

    scored_n: int = 0
    ended_n: int = 0
    attempts_n: int = 0
    by_object: dict[str, tuple[int, int]] = Field(default_factory=dict)
    tolerated: float = Field(default=UNKNOWN, ge=1.0)
    tolerated_of: dict[str, float] = Field(default_factory=dict)
    score: Bet = Bet()
    covers: tuple[Bet, Bet] = (Bet(), Bet())
    misses: tuple[Bet, Bet] = (Bet(), Bet())
    slow: Bet = Bet()

    def worth(self, role: Role) -> float:
        """Evidence for deciding with it: for a shadow the weakest of all requirements, else the mean.

        The previous version decides again if any fault of the active one is shown.
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
        """The mean number of attempts to tolerate of a version that takes over."""
        return TOLERATED * self.attempts_n / self.ended_n if self.ended_n >= KNOWN_N else UNKNOWN

    @property
    def tolerates_of(self) -> dict[str, float]:
        """The same by object: objects come in batches. Of one that is not known yet, `UNKNOWN` at least."""
        counted = {of: counted for of, counted in self.by_object.items() if counted[0] >= SOME_N}
        means = {of: (ended_n, TOLERATED * attempts_n / ended_n) for of, (ended_n, attempts_n) in counted.items()}
        return {of: mean if ended_n >= KNOWN_N else max(UNKNOWN, mean) for of, (ended_n, mean) in means.items()}

    def ended(self, attempts: int, of: str) -> Self:
        """An insertion of an object ended after so many attempts, `FAILED` if decisions may have made it fail."""
        ended_n, attempts_n = self.by_object.get(of, (0, 0))
        by_object = self.by_object | {of: (ended_n + 1, attempts_n + attempts)}
        tolerated = self.tolerated_of.get(of, max(UNKNOWN, self.tolerated))
        counted = {
            "ended_n": self.ended_n + 1,
            "attempts_n": self.attempts_n + attempts,
            "by_object": by_object if len(by_object) <= OBJECTS_N else self.by_object,
            "slow": self.slow.on((attempts - tolerated) / tolerated),
        }
        return self.model_copy(update=counted)

    def scored(self, better: float) -> Self:
        """Add an attempt's outcome: ``better`` is the difference of the predictions' scores."""
        return self.model_copy(update={"scored_n": self.scored_n + 1, "score": self.score.on(better / WORST)})

    def held(self, held: Held, active_held: Held) -> Self:
        """An insertion went in, and its first error is known."""
        covers = tuple(bet.that(one, LEAST_COVERAGE) for bet, one in zip(self.covers, held, strict=True))
        missed = tuple(None if one is None else not one for one in active_held)
        misses = tuple(bet.that(one, 1.0 - LEAST_COVERAGE) for bet, one in zip(self.misses, missed, strict=True))
        return self.model_copy(update={"covers": covers, "misses": misses})


def log_score(chance: float, *, inserted: bool) -> float:
    """Score of a ``chance`` that an attempt inserts, once its outcome is known: from -WORST to about 0."""
    chance = min(SUREST, max(1.0 - SUREST, chance))
    return math.log(chance if inserted else 1.0 - chance)


def intervals_hold(evidence: Evidence | None, error: tuple[float, float]) -> Held:
    """Whether the 90 % intervals of x and of yaw hold the error, None without intervals."""
    if evidence is None or evidence.sigma is None:
        return None, None
    estimate = evidence.estimate()
    sides = zip((estimate.interval_x_mm, estimate.interval_theta_deg), error, strict=True)
    x, theta = (None if interval is None else interval[0] <= at <= interval[1] for interval, at in sides)
    return x, theta
