"""A cell that is wired wrong contradicts the moves that are commanded; a good one never does."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.contract import wire
from service.contract.words.wiring import WIRINGS
from service.decision.consistency import Consistency, one_sided
from service.decision.evidence import Refusal
from service.perception.observation import PairObservation
from tests.service.decision.test_claim import observation

ERRORS = st.tuples(st.floats(-16, 16), st.floats(-14, 14))
BLIND = (3.0, 10.0)


def pair(left_deg: float = 4.0, right_deg: float = -4.0) -> PairObservation:
    turns = ("left", left_deg), ("right", right_deg)
    return PairObservation(*(observation(finger, angle_rad=math.radians(turn_deg)) for finger, turn_deg in turns))


def correction(here: tuple[float, float], sigma: tuple[float, float], move: tuple[float, float]) -> wire.Correction:
    estimate = wire.Estimate(dx_mm=here[0], dtheta_deg=here[1], sigma_x_mm=sigma[0], sigma_theta_deg=sigma[1])
    return wire.Correction(
        insertion_id="one",
        attempt=1,
        dx_mm=move[0],
        dtheta_deg=move[1],
        class_probabilities={},
        estimate=estimate,
        confidence=0.9,
        controller="belief",
        reason="test",
        latency_ms={},
    )


def answered(steps: list[tuple[tuple[float, float], tuple[float, float], tuple[float, float]]]) -> str:
    """Text of the refusal, empty if the steps are consistent."""
    consistency = Consistency()
    for here, sigma, move in steps:
        try:
            answer = correction(here, sigma, move)
            consistency.add(answer.estimate, pair())
            consistency.move(answer)
        except Refusal as refusal:
            return f"{refusal.reason}: {refusal}"
    return ""


@given(ERRORS, st.tuples(st.floats(-2.5, 2.5), st.floats(-4, 4)))
def test_a_correction_that_helped_is_never_contradictory(error: tuple[float, float], rest: tuple[float, float]) -> None:
    move = (-error[0], -error[1])
    assert not answered([(error, (0.8, 1.6), move), (rest, (0.9, 1.8), (-rest[0], -rest[1])), ((0, 0), BLIND, (1, 0))])


@pytest.mark.parametrize(
    ("signs", "named"),
    [((-1, 1), "in x reach the arm reversed, or the fingers are swapped"), ((1, -1), "in yaw"), ((-1, -1), "mirrored")],
)
def test_a_reversed_cell_is_named_while_the_error_doubles(signs: tuple[int, int], named: str) -> None:
    here, steps = (3.5, 3.2), []
    for _ in range(3):
        move = (-here[0], -here[1])
        steps.append((here, (0.8, 1.5), move))
        here = (here[0] + signs[0] * move[0], here[1] + signs[1] * move[1])
    assert named in answered(steps)


GOOD = [
    [
        ((-12.1, 11.7), (2.0, 2.7), (12.5, -11.5)),
        ((-5.6, -4.0), (3.1, 4.4), (3.0, 0.9)),
        ((3.8, -1.0), (2.8, 4.3), (0, 0)),
    ],
    [
        ((10.9, 7.6), (2.2, 2.3), (-11.5, -7.6)),
        ((-6.1, -7.0), (3.0, 4.0), (3.4, 1.6)),
        ((5.4, -4.3), (2.6, 3.9), (0, 0)),
    ],
    [
        ((-10.3, -10.4), (2.1, 2.7), (10.5, 10.4)),
        ((4.3, 4.1), (3.0, 3.9), (-3, -1.4)),
        ((-4.0, 5.4), (2.5, 3.7), (0, 0)),
    ],
]
"""The same in good cells: networks that were sure of a large error are less so of the small one that is left."""


@pytest.mark.parametrize("steps", GOOD)
def test_networks_that_become_unsure_where_a_correction_has_helped_accuse_nobody(
    steps: list[tuple[tuple[float, float], tuple[float, float], tuple[float, float]]],
) -> None:
    assert answered(steps) == ""


def test_a_large_error_that_was_commanded_is_no_contradiction() -> None:
    sure = (1.0, 2.0)
    towards = [((6.0, 0.0), sure, (4.0, 0.0)), ((0.0, 0.0), BLIND, (4.0, 0.0)), ((14.0, 0.0), sure, (-4.0, 0.0))]
    assert answered(towards) == ""


def test_attempts_in_the_dark_alone_prove_nothing() -> None:
    assert not answered([((0.1, 1.3), BLIND, (0.0, 10.0)), ((0.0, 1.6), BLIND, (0.0, -15.0)), ((0, 1), BLIND, (1, 7))])


REVERSED = [
    ((-6.9, 7.6), (2.6, 3.5), (7.5, -7.9)),
    ((-9.5, 0.7), (2.9, 5.1), (4.9, -0.5)),
    ((-10.4, -0.1), (3.3, 5.2), (4.1, 0.0)),
    ((-13.0, 0.6), (2.8, 5.6), (4.0, -0.2)),
]
"""The estimates and commands of an arm that moves x the other way, in a drawn cell."""


def test_networks_that_are_never_sure_name_a_reversed_cell_by_the_fourth_attempt() -> None:
    assert answered(REVERSED[:2]) == ""
    assert "in x" in answered(REVERSED)


@pytest.mark.parametrize(("searched_n", "named"), [(2, True), (8, False)])
def test_who_has_searched_for_long_is_not_accused_of_being_wired_wrong(searched_n: int, *, named: bool) -> None:
    waiting = ((-6.9, 7.6), (2.6, 3.5), (0.0, 0.0))
    assert ("in x" in answered([waiting] * searched_n + REVERSED)) == named


@given(ERRORS, st.lists(st.tuples(st.floats(-1.2, 1.2), st.floats(-1.2, 1.2)), min_size=3, max_size=8))
def test_a_good_cell_whose_networks_are_never_sure_is_not_accused(
    error: tuple[float, float], off: list[tuple[float, float]]
) -> None:
    """Its estimates err by up to 1.2 of the sigma that they come with, and each is taken off."""
    sigma, true, steps = (3.5, 6.0), np.array(error), []
    for share in off:
        estimate = true + np.multiply(share, sigma)
        steps.append((tuple(estimate), sigma, tuple(-estimate)))
        true = true - estimate
    assert answered(steps) == ""


@pytest.mark.parametrize(
    ("left", "right", "counts"),
    [
        (4.0, -4.0, -1),
        (4.0, 3.8, 2),
        (-2.0, -1.9, 2),
        (0.4, 0.4, 1),
        (-0.75, -1.44, 1),  # seen in a good cell of stiff gels
        (0.1, 0.1, 0),
        (3.0, -1.6, -1),
        (2.0, 0.1, 0),
        (0.0, 4.0, 0),
    ],
)
def test_two_fingers_must_see_a_turn_from_opposite_sides(left: float, right: float, counts: int) -> None:
    assert one_sided(pair(left, right)) == one_sided(pair(right, left)) == counts


def mirrored_at(*turns: tuple[float, float]) -> int | None:
    """The attempt after which one picture is called mirrored, None if never."""
    consistency = Consistency()
    for attempt, (left, right) in enumerate(turns, 1):
        try:
            answer = correction((1.0, 1.0), (4.0, 6.0), (-1.0, -1.0))
            consistency.add(answer.estimate, pair(left, right))
            consistency.move(answer)
        except Refusal as refusal:
            return attempt if "one picture is mirrored" in str(refusal) else None
    return None


def test_a_clear_turn_from_one_side_is_enough_and_of_small_ones_two_that_nothing_contradicts() -> None:
    assert mirrored_at((2.0, 1.9)) == 1
    assert mirrored_at((0.4, 0.4), (0.0, 0.0), (-0.5, -0.4)) == 3
    assert mirrored_at((-0.75, -1.44), (0.4, -0.4), (0.4, 0.4), (1.0, -1.0)) is None


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_turn_that_is_not_finite_is_no_evidence(bad: float) -> None:
    assert one_sided(pair(bad, 4.0)) == one_sided(pair(4.0, bad)) == one_sided(pair(bad, bad)) == 0


def explained(odds: dict[tuple[int, int], float]) -> list[str]:
    """Causes named where each wiring explains the attempts so many times better than a good cell."""
    consistency = Consistency()
    for signs, followed in consistency._followed.items():
        followed.log_evidence = math.log(odds.get(signs, 1e-3)) if signs != (1, 1) else 0.0
    return consistency.causes()


def test_a_reversed_cell_is_named_from_odds_of_twenty_on_and_with_it_what_is_up_to_five_times_unlikelier() -> None:
    first, second, _ = WIRINGS
    assert explained({first: 19.9}) == []
    assert explained({first: 20.1}) == [WIRINGS[first]]
    assert explained({first: 100.0, second: 20.1}) == [WIRINGS[first], WIRINGS[second]]
    assert explained({first: 100.0, second: 19.9}) == [WIRINGS[first]]
    assert explained({first: 40.0, second: 90.0}) == [WIRINGS[second], WIRINGS[first]], "the likeliest first"
