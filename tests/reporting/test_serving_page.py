"""What the page on serving states of a tail is what so many values can show."""

import pytest

from tests.benchmarks.serving import quantiles
from tests.benchmarks.serving_report import both


@pytest.mark.parametrize(
    ("values_n", "stated"),
    [
        (30, "15.5 / 16.5 ms (n = 30 / 30; largest 30 / 31)"),
        (299, "150.0 / 151.0 ms (n = 299 / 299; largest 299 / 300)"),
        (300, "150.5 / 151.5 ms (n = 300 / 300; p99 297 / 298)"),
    ],
)
def test_a_quantile_of_few_values_is_their_largest(values_n: int, stated: str) -> None:
    ours, theirs = ([float(at) for at in range(first, first + values_n)] for first in (1, 2))
    assert both(quantiles(ours), quantiles(theirs)) == stated


def test_of_few_values_whose_largest_was_not_kept_no_tail_is_stated() -> None:
    kept = {"p50_ms": 11.13, "p99_ms": 14.14, "n": 30}
    assert both(kept, kept) == "11.1 / 11.1 ms (n = 30 / 30)"
