"""Intervals agree with scipy's and hold their figure."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from reporting.statistics import Estimate, bootstrap, clustered, mean, number, percentiles, wilson

COUNTS = st.integers(1, 10_000).flatmap(lambda count: st.tuples(st.integers(0, count), st.just(count)))


@given(COUNTS)
def test_wilson_is_scipys(counts):
    hits, count = counts
    expected = stats.binomtest(hits, count).proportion_ci(method="wilson")
    assert wilson(hits, count) == pytest.approx((hits / count, expected.low, expected.high), abs=1e-12)


@given(COUNTS)
def test_wilson_holds_its_share_and_stays_within_one(counts):
    share, low, high = wilson(*counts)
    assert 0.0 <= low <= share <= high <= 1.0


def test_groups_that_end_alike_count_as_fewer_trials_and_never_as_more():
    twelve = [32] * 12
    one_fails = clustered([0, *[32] * 11], twelve)
    assert one_fails.value == pytest.approx(11 / 12)
    assert one_fails.low < wilson(11, 12).low + 0.02, "a cell in which nothing goes in is one observation"
    assert clustered([29, 30, 28, 29], [32] * 4) == wilson(116, 128)
    for hits, counts in (([20], [32]), ([0, 0], [32, 30]), ([32, 30], [32, 30]), ([], []), ([0], [0])):
        assert str(clustered(hits, counts)) == str(wilson(sum(hits), sum(counts)))


@settings(max_examples=20, deadline=None)
@given(st.floats(0.1, 0.9), st.floats(0.2, 20.0), st.integers(0, 2**20))
def test_a_grouped_interval_holds_the_share_of_fresh_groups(share, alike, seed):
    """Groups drawn around a share, from nearly all alike to nearly independent."""
    rng = np.random.default_rng(seed)
    of_each = rng.beta(alike * share, alike * (1 - share), (400, 40))
    made = [clustered(hits, [25] * 40) for hits in rng.binomial(25, of_each)]
    assert np.mean([one.low <= share <= one.high for one in made]) > 0.88


def test_nothing_has_the_widest_interval_and_is_written_as_a_dash():
    value, *ends = wilson(0, 0)
    assert math.isnan(value)
    assert ends == [0.0, 1.0]
    assert f"{wilson(0, 0):.0%}" == "-"


@given(st.lists(st.floats(-1e3, 1e3), min_size=2, max_size=50))
def test_a_mean_has_the_interval_of_its_standard_error(values):
    estimate = mean(values)
    assert estimate.value == pytest.approx(np.mean(values), abs=1e-9)
    assert estimate.high - estimate.value == pytest.approx(stats.norm.ppf(0.975) * stats.sem(values), abs=1e-6)


def test_one_value_has_no_spread():
    assert mean([3.0]) == (3.0, 3.0, 3.0)


def test_a_bootstrap_interval_is_of_percentiles():
    assert bootstrap(0.5, np.linspace(0.0, 1.0, 1001).tolist()) == pytest.approx((0.5, 0.025, 0.975))


def test_percentiles_of_nothing_are_none_of_anything():
    assert percentiles([1.0, 2.0, 3.0], 50, 0) == [2.0, 1.0]
    assert all(map(math.isnan, percentiles([], 50, 99)))


@pytest.mark.parametrize(
    ("value", "spec", "text"),
    [(None, ".1f", "-"), (math.nan, ".1%", "-"), (0.5, ".1%", "50.0 %"), (-0.25, "+.2f", "-0.25"), (7, "", "7")],
)
def test_numbers_are_written_in_one_way(value, spec, text):
    assert number(value, spec) == text


def test_an_estimate_shows_its_interval():
    assert f"{wilson(86, 100):.1%}" == "86.0 % (77.9 .. 91.5)"
    assert f"{Estimate(2.0, 1.5, 2.5):.2f}" == "2.00 (1.50 .. 2.50)"
