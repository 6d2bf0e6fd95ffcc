import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulation.closed_loop import report, statistics

COURSE = {"block_mm": 0.2, "block_tilt_deg": 0.1, "in_hand_mm": 1.0, "slipped_mm": 0.3, "force_n": 9.0, "unsolved": 0}
DECISION = {
    "type": "correction",
    "class_probabilities": {"5": 0.8, "6": 0.2},
    "estimate": {"dx_mm": 4.0, "dtheta_deg": 7.0, "sigma_x_mm": 1.0, "sigma_theta_deg": 2.0},
}
ROW = {
    "scene": "rectangle",
    "controller": "belief",
    "index": 0,
    "seed": 0,
    "perception": "pictures",
    "condition": "",
    "inserted": True,
    "claimed": True,
    "void": False,
    "attempts": 3,
    "grasp_kept": True,
    "course": COURSE,
    "x_mm": 5.0,
    "theta_deg": -3.0,
    "trials": [{"error_before": [5.0, 8.0], "decision": DECISION}],
}


def page_of(rows):
    return report.closed_loop_page(report.report_of(rows, {}))


def test_a_failure_counts_as_sixteen_trials():
    rows = [ROW, ROW | {"inserted": False, "attempts": 15}]
    (summary,) = statistics.summarise(rows)
    assert summary["mean_trials"] == pytest.approx((3 + 16) / 2)
    assert summary["success"] == 0.5
    assert ">15" in page_of([ROW, ROW | {"inserted": False, "attempts": 15}])


def test_an_insertion_that_is_only_claimed_is_none():
    (summary,) = statistics.summarise([ROW | {"inserted": False}])
    assert (summary["inserted"], summary["claimed_wrongly"]) == (0, 1)


def test_the_table_says_whose_figures_are_simulated():
    text = page_of([ROW])
    assert "inserted (simulated)" in text
    assert "real robot" in text
    assert "100 %, 4.7, 11" in text


def test_a_shortfall_is_named_with_its_cause():
    failed = ROW | {"inserted": False, "attempts": 15}
    oracle = ROW | {"controller": "oracle", "attempts": 2}
    text = page_of([failed, oracle])
    assert "99.0 points of success, 12.70 trials" in text
    assert "controller" in text


def test_starts_are_the_four_extremes_then_uniform_and_repeat_by_seed():
    starts = statistics.start_errors(30, 7, (18.0, 15.0))
    assert {(abs(x), abs(t)) for x, t in starts[:4]} == {(18.0, 15.0)}
    assert len({(math.copysign(1, x), math.copysign(1, t)) for x, t in starts[:4]}) == 4
    assert all(abs(x) <= 18.0 and abs(t) <= 15.0 for x, t in starts)
    assert starts == statistics.start_errors(30, 7, (18.0, 15.0)) != statistics.start_errors(30, 8, (18.0, 15.0))


@given(st.floats(-20, 20), st.floats(-20, 20))
def test_every_error_has_one_class(x, theta):
    mirror = {"1": "2", "2": "1", "3": "6", "6": "3", "4": "5", "5": "4", "7": "8", "8": "7", "near": "near"}
    assert mirror[statistics.class_of(x, theta)] == statistics.class_of(-x, -theta)


def test_the_confusion_matrix_counts_truth_by_row():
    counts = statistics.confusion([ROW])
    assert counts.sum() == 1
    assert counts[4, 4] == 1


def test_first_estimates_are_judged_against_the_truth():
    found = statistics.estimates([ROW])
    assert found is not None
    assert (found["rmse_x_mm"], found["rmse_theta_deg"]) == (1.0, 1.0)


def test_baselines_are_compared_on_the_starts_that_they_played():
    """The extremes come first: of 4 starts they are all, of 8 half."""
    mine = [ROW | {"index": index, "attempts": 3 if index < 4 else 1} for index in range(8)]
    theirs = [ROW | {"index": index, "controller": "oracle", "attempts": 2} for index in range(4)]
    shared = report.on_shared_starts(mine + theirs)
    table = report.baseline_table(statistics.summarise(mine + theirs), shared).markdown()
    assert "our networks (8) | 100 %, 2.00 " in table
    assert "on the starts of the rows below (4) | 100 %, 3.00 " in table
    assert not report.on_shared_starts(mine[:4] + theirs)


@given(st.integers(1, 5000), st.data())
def test_a_hundred_per_cent_is_said_of_all_alone(count, data):
    inserted = data.draw(st.integers(0, count))
    row = {"success": inserted / count, "mean_trials": 2.0, "mean_trials_standard_error": None}
    assert report._reached(row).startswith("100") == (inserted == count)
