"""The rule by which versions change places errs as seldom as it says, and notices what it is for."""

import math

import numpy as np
import pytest

from service.contract import ErrorClass, wire
from service.decision.evidence import Evidence
from service.decision.models import load_models
from service.versions.contest import ENOUGH, STAKES, WORST, Bet, Contest, held, log_score

COVERS = 0.9
Rng = np.random.Generator


def work(
    contest: Contest,
    rng: Rng,
    better: float = 0.0,
    *,
    covers: float = COVERS,
    active: float = COVERS,
    fails: float = 0.04,
) -> Contest:
    """One insertion: two thirds of those that go in were blocked before; scores differ by ``better`` on the mean."""
    if rng.random() < fails:
        return contest.ended(failed=True)
    contest = contest.ended(failed=False)
    if rng.random() < 1 / 3:
        return contest
    gain = float(np.clip(better + 0.8 * rng.standard_t(3), -WORST, WORST))
    x, theta, active_x, active_theta = (bool(v) for v in rng.random(4) < [covers, covers, active, active])
    return contest.scored(gain, (x, theta), (active_x, active_theta))


def insertions_until(role, most_n: int, rng: Rng, start: Contest | None = None, **cell: float) -> float:
    """After how many insertions the version beside would decide; infinite if not within ``most_n``."""
    contest = start or Contest()
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


@pytest.mark.parametrize(("runs_n", "most_n"), [(120, 250), pytest.param(1000, 1500, marks=pytest.mark.slow)])
def test_a_version_that_is_no_better_is_promoted_in_at_most_one_of_twenty_cells(runs_n: int, most_n: int) -> None:
    assert share_within("shadow", runs_n, most_n, seed=1) <= 1 / ENOUGH


@pytest.mark.parametrize(("runs_n", "most_n"), [(120, 250), pytest.param(1000, 1500, marks=pytest.mark.slow)])
def test_a_better_one_whose_intervals_hold_three_quarters_is_not_promoted_more_often(runs_n: int, most_n: int) -> None:
    assert share_within("shadow", runs_n, most_n, seed=2, better=0.5, covers=0.75) <= 1 / ENOUGH


@pytest.mark.parametrize(("runs_n", "most_n"), [(120, 250), pytest.param(1000, 1500, marks=pytest.mark.slow)])
def test_a_version_that_is_as_good_as_the_one_before_is_rolled_back_in_at_most_one_of_twenty_cells(
    runs_n: int, most_n: int
) -> None:
    at_the_edge = {"active": 0.75, "fails": 0.1}  # as bad as is tolerated
    assert share_within("previous", runs_n, most_n, seed=3, **at_the_edge) <= 1 / ENOUGH


@pytest.mark.parametrize(
    ("role", "cell", "median_n"),
    [
        ("shadow", {"better": 0.5}, 160),
        ("previous", {"better": 0.5}, 200),
        ("previous", {"active": 0.5}, 80),
        ("previous", {"fails": 0.5}, 30),
    ],
)
def test_what_it_is_for_is_noticed(role, cell: dict[str, float], median_n: int) -> None:
    rng = np.random.default_rng(4)
    needed = [insertions_until(role, 600, rng, **cell) for _ in range(25)]
    assert float(np.median(needed)) <= median_n


def test_what_turns_after_a_thousand_good_insertions_is_noticed_too() -> None:
    rng = np.random.default_rng(5)
    contest = Contest()
    for _ in range(1000):
        contest = work(contest, rng)
    assert contest.worth("previous") < 1.0
    assert insertions_until("previous", 100, rng, contest, fails=0.5) <= 60


def test_a_cell_that_always_failed_often_is_not_blamed_on_the_new_version() -> None:
    contest = Contest()
    for number in range(100):
        contest = contest.ended(failed=number % 4 == 0)
    assert contest.tolerates == pytest.approx(0.5)
    assert Contest().tolerates == pytest.approx(0.1)


def evidence(error: tuple[float, float], sigma: tuple[float, float]) -> Evidence:
    signs = [(x, theta) for x in (-1, 0, 1) for theta in (-1, 0, 1)]
    classes = tuple(ErrorClass(name=f"{x}{theta}", sign_x=x, sign_theta=theta) for x, theta in signs)
    return Evidence(classes, np.full(9, 1 / 9), error, sigma)


def test_who_says_where_the_error_was_scores_better_than_who_refuses_and_who_errs_worse(models_folder) -> None:
    models, error = load_models(models_folder), (8.0, 5.0)
    arm = wire.Arm(insertion_id="one", attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0)
    answers = evidence((7.0, 6.0), (1.5, 2.0)), None, evidence((-7.0, -6.0), (1.5, 2.0))
    scores = [log_score(models, answer, arm, error) for answer in answers]
    assert scores == sorted(scores, reverse=True)
    assert scores[0] - scores[1] > 0.5 < scores[1] - scores[2]
    assert all(-WORST <= score <= 0.0 for score in scores)
    assert held(answers[0], error) == (True, True)
    assert held(answers[1], error) == (None, None)
    assert held(answers[2], error) == (False, False)
