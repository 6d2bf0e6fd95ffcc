"""Every hard case holds: the cheap ones on one seed always, all of them on three seeds in the long tests."""

import pytest

from tests.hard_cases.mutants import MUTANTS, survives
from tests.hard_cases.registry import SEEDS, run
from tests.hard_cases.suite import CASES

ROOMS = {"physics", "perception", "networks", "decision", "motion", "data"}


def summary(result):
    return f"worst {result.worst:.3g}, limit {result.case.limit:g} {result.note} {result.error}"


@pytest.mark.parametrize("name", [case.name for case in CASES.values() if case.quick])
def test_the_case_holds(name):
    result = run(CASES[name], SEEDS[:1])
    assert result.passed, summary(result)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", list(CASES))
def test_the_case_holds_on_three_seeds(name):
    result = run(CASES[name])
    assert result.passed, summary(result)


def test_every_room_has_cases_and_there_are_at_least_sixty():
    assert {case.room for case in CASES.values()} == ROOMS
    assert len(CASES) >= 60


@pytest.mark.parametrize("name", list(CASES))
def test_every_case_says_why_it_is_hard_and_what_answers_it(name):
    case = CASES[name]
    assert case.why
    assert case.holds
    case.guard.resolve()
    assert bool(case.guard.without) == (case.guard.instead is not None)


def test_at_least_90_guards_can_be_taken_away():
    assert len(MUTANTS) >= 90


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", MUTANTS)
def test_without_its_guard_the_case_fails(name):
    assert not survives(CASES[name])
