"""The rule for changing versions errs as rarely as stated, and detects real differences."""

import math

import numpy as np
import pytest

from service.contract import ErrorClass
from service.decision.evidence import Evidence
from service.versions.contest import (
    ENOUGH,
    FAILED,
    KNOWN_N,
    SOME_N,
    STAKES,
    WORST,
    Bet,
    Contest,
    intervals_hold,
    log_score,
)

COVERS = 0.9
Rng = np.random.Generator


def work(
    contest: Contest,
    rng: Rng,
    better: float = 0.0,
    *,
    covers: float = COVERS,
    active: float = COVERS,
    attempts: float = 2.5,
) -> Contest:
    """One insertion of so many ``attempts`` on the mean; scores differ by ``better`` on the mean."""
    tried = min(FAILED, int(rng.geometric(1 / attempts)))
    contest = contest.ended(tried, "box")
    if tried in {1, FAILED}:
        return contest
    gain = float(np.clip(better + 0.5 * rng.standard_t(3), -WORST, WORST))
    x, theta, active_x, active_theta = (bool(v) for v in rng.random(4) < [covers, covers, active, active])
    return contest.scored(gain).held((x, theta), (active_x, active_theta))


def insertions_until(role, most_n: int, rng: Rng, start: Contest | None = None, **cell: float) -> float:
    """After how many insertions the version beside would decide; infinite if not within ``most_n``."""
    contest = start or Contest(tolerated_of={"box": 2.75})
    for number in range(1, most_n + 1):
        contest = work(contest, rng, **cell)
        if contest.worth(role) >= ENOUGH:
            return number
    return math.inf


def share_within(role, runs_n: int, most_n: int, seed: int, **cell: float) -> float:
    rng = np.random.default_rng(seed)
    return sum(math.isfinite(insertions_until(role, most_n, rng, **cell)) for _ in range(runs_n)) / runs_n


def test_a_bet_on_a_fair_coin_stays_worth_one_on_the_mean_and_never_needs_more_than_it_has() -> None:
    for gain in (-1.0, -0.2, 0.0, 3.0):
        bet = Bet().on(gain)
        assert min(bet.capital) >= 0.0
        assert Bet().on(-gain if abs(gain) <= 1 else 0.0).worth > 0.0
    up, down = (Bet().on(0.3).on(gain).worth for gain in (0.5, -0.5))
    assert 0.5 * (up + down) == pytest.approx(Bet().on(0.3).worth, rel=1e-12)
    assert len(Bet().capital) == len(STAKES)


def test_a_bet_that_is_won_for_months_goes_on() -> None:
    bet = Bet()
    for _ in range(5000):
        bet = bet.that(happened=True, rate=0.75)
    assert math.isfinite(bet.worth)
    for _ in range(200):
        bet = bet.that(happened=False, rate=0.75)
    assert bet.worth < ENOUGH, "what was won long ago proves nothing against what is lost now"


@pytest.mark.parametrize(("runs_n", "most_n"), [(120, 250), pytest.param(300, 800, marks=pytest.mark.slow)])
def test_a_version_that_is_no_better_is_promoted_in_at_most_one_of_twenty_cells(runs_n: int, most_n: int) -> None:
    assert share_within("shadow", runs_n, most_n, seed=1) <= 1 / ENOUGH


@pytest.mark.parametrize(("runs_n", "most_n"), [(120, 250), pytest.param(300, 800, marks=pytest.mark.slow)])
def test_a_better_one_whose_intervals_hold_three_quarters_is_not_promoted_more_often(runs_n: int, most_n: int) -> None:
    assert share_within("shadow", runs_n, most_n, seed=2, better=0.5, covers=0.75) <= 1 / ENOUGH


@pytest.mark.parametrize(("runs_n", "most_n"), [(120, 250), pytest.param(300, 800, marks=pytest.mark.slow)])
def test_a_version_that_is_as_good_as_the_one_before_is_rolled_back_in_at_most_one_of_twenty_cells(
    runs_n: int, most_n: int
) -> None:
    at_the_edge = {"active": 0.75, "attempts": 2.75}  # as bad as is tolerated
    assert share_within("previous", runs_n, most_n, seed=3, **at_the_edge) <= 1 / ENOUGH


@pytest.mark.parametrize(
    ("role", "cell", "median_n"),
    [
        ("shadow", {"better": 0.5}, 160),
        ("previous", {"better": 0.5}, 200),
        ("previous", {"active": 0.5}, 80),
        ("previous", {"attempts": 4.0}, 120),
    ],
)
def test_what_it_is_for_is_noticed(role, cell: dict[str, float], median_n: int) -> None:
    rng = np.random.default_rng(4)
    needed = [insertions_until(role, 600, rng, **cell) for _ in range(25)]
    assert float(np.median(needed)) <= median_n


def test_what_turns_after_a_thousand_good_insertions_is_noticed_too() -> None:
    rng = np.random.default_rng(5)
    contest = Contest(tolerated_of={"box": 2.75})
    for _ in range(1000):
        contest = work(contest, rng)
    assert contest.worth("previous") < 1.0
    assert insertions_until("previous", 300, rng, contest, attempts=5.0) <= 120


@pytest.mark.parametrize(("attempts", "early"), [(6, {"box": pytest.approx(6.6)}), (2, {"box": 5.0})])
def test_what_an_object_took_is_tolerated_and_more_before_it_is_known(attempts: int, early: dict[str, float]) -> None:
    contest, tolerated = Contest(), {}
    for number in range(1, KNOWN_N + 1):
        contest = contest.ended(attempts, "box")
        tolerated[number] = contest.tolerates, contest.tolerates_of
    assert tolerated[SOME_N - 1] == (5.0, {}), "so few tell too little"
    assert tolerated[SOME_N] == tolerated[KNOWN_N - 1] == (5.0, early)
    mean = pytest.approx(1.1 * attempts)
    assert tolerated[KNOWN_N] == (mean, {"box": mean})


def promoted_after(*packed: tuple[str, float, int], rng: Rng) -> Contest:
    """The contest of a version promoted after so many insertions of each object, with so many attempts on the mean."""
    before = Contest()
    for of, attempts, count in packed:
        for tried in rng.geometric(1 / attempts, count):
            before = before.ended(min(FAILED, int(tried)), of)
    return Contest(tolerated=before.tolerates, tolerated_of=before.tolerates_of)


def slowed(contest: Contest, of: str, attempts: float, most_n: int, rng: Rng) -> bool:
    """Whether such insertions roll the version back."""
    for tried in rng.geometric(1 / attempts, most_n):
        contest = contest.ended(min(FAILED, int(tried)), of)
        if contest.worth("previous") >= ENOUGH:
            return True
    return False


@pytest.mark.parametrize("quick_n", [0, 40, 140])
def test_an_object_that_always_took_long_is_not_blamed_on_the_new_version_whatever_else_was_packed(
    quick_n: int,
) -> None:
    rng, runs_n = np.random.default_rng(9), 20
    packed = [("box", 6.5, 100), *([("hexagon", 1.8, quick_n)] if quick_n else [])]
    back_n = sum(slowed(promoted_after(*packed, rng=rng), "box", 6.5, 400, rng) for _ in range(runs_n))
    assert back_n <= runs_n / ENOUGH


def test_a_version_that_takes_over_after_a_failure_may_not_fail_for_ever() -> None:
    before = Contest().ended(FAILED, "box")
    after = Contest(tolerated=before.tolerates, tolerated_of=before.tolerates_of)
    for _ in range(10):
        after = after.ended(FAILED, "box")
    assert after.worth("previous") >= ENOUGH


@pytest.mark.slow
def test_a_version_as_good_as_what_was_counted_before_it_is_rolled_back_in_at_most_one_of_twenty_cells() -> None:
    """What was counted is itself drawn, and may be too small by chance: the less, the more was counted."""
    rng, runs_n = np.random.default_rng(8), 200
    box = ("box", 3.09, KNOWN_N)
    back_n = sum(slowed(promoted_after(box, rng=rng), "box", 3.09, 10_000, rng) for _ in range(runs_n))
    assert back_n <= runs_n / ENOUGH


def test_another_product_that_needs_more_attempts_is_not_blamed_on_the_new_version() -> None:
    rng, runs_n = np.random.default_rng(6), 60
    hexagons = ("hexagon", 1.78, 200)
    back_n = sum(slowed(promoted_after(hexagons, rng=rng), "white box", 3.59, 250, rng) for _ in range(runs_n))
    assert back_n <= runs_n / ENOUGH
    slow = promoted_after(("hexagon", 6.0, 200), rng=rng)
    assert slow.tolerated_of.keys() == {"hexagon"}
    assert slow.ended(6, "new").slow.worth < 1.0, "nor are they fewer for it than for what the cell packed"
    few = promoted_after(hexagons, ("white box", 1.2, 20), rng=rng)
    assert few.tolerated_of.keys() == {"hexagon"}, "20 insertions tell too little"


def test_more_attempts_for_a_known_object_are_noticed_although_another_needs_as_many() -> None:
    rng, runs_n = np.random.default_rng(7), 20
    both = ("hexagon", 1.78, 200), ("white box", 3.59, 200)
    assert sum(slowed(promoted_after(*both, rng=rng), "hexagon", 3.59, 250, rng) for _ in range(runs_n)) == runs_n


def test_a_client_that_names_each_object_differently_fills_no_disk() -> None:
    contest = Contest()
    for number in range(100):
        contest = contest.ended(2, f"number {number}")
    assert (len(contest.by_object), contest.ended_n) == (32, 100)


def evidence(error: tuple[float, float], sigma: tuple[float, float]) -> Evidence:
    signs = [(x, theta) for x in (-1, 0, 1) for theta in (-1, 0, 1)]
    classes = tuple(ErrorClass(name=f"{x}{theta}", sign_x=x, sign_theta=theta) for x, theta in signs)
    return Evidence(classes, np.full(9, 1 / 9), error, sigma)


def test_who_foretells_what_comes_out_scores_best_and_nobody_is_too_sure_for_it() -> None:
    scores = [log_score(chance, inserted=True) for chance in (1.0, 0.7, 0.3, 0.0)]
    assert scores == sorted(scores, reverse=True)
    assert scores == pytest.approx([log_score(1.0 - chance, inserted=False) for chance in (1.0, 0.7, 0.3, 0.0)])
    assert scores[-1] == pytest.approx(-WORST)
    chances = np.linspace(0.05, 0.95, 19)  # the mean is best for the chance that is true: it does not pay to exaggerate
    means = [0.6 * log_score(one, inserted=True) + 0.4 * log_score(one, inserted=False) for one in chances]
    assert chances[int(np.argmax(means))] == pytest.approx(0.6)


def test_intervals_hold_an_error_or_do_not_or_are_none() -> None:
    error = (8.0, 5.0)
    assert intervals_hold(evidence((7.0, 6.0), (1.5, 2.0)), error) == (True, True)
    assert intervals_hold(evidence((-7.0, 6.0), (1.5, 2.0)), error) == (False, True)
    assert intervals_hold(None, error) == (None, None)
