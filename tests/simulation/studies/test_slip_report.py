"""The slip report's own arithmetic, and one small run of all of it."""

import json

import numpy as np
import pytest

from reporting.statistics import wilson
from simulation.__main__ import main
from simulation.studies.slip import tracking
from simulation.studies.slip.detection import Tally, alarm_of, true_fields
from simulation.studies.slip.tracking import accuracy_at_noise
from simulation.studies.slip.trials import draw_trials


def test_trials_know_their_truth_and_repeat():
    trials = list(draw_trials(4, 3, 30))
    for trial, other in zip(trials, draw_trials(2, 3, 30), strict=False):
        assert np.array_equal(trial.gel, other.gel)
    for trial in trials:
        assert (trial.label == "slip") == (trial.slip_frame >= 0)
        assert np.isfinite(trial.gel).all()
        if trial.kind != "slip":
            assert trial.label != "slip"


def test_a_late_and_an_early_alarm_are_not_right():
    trials = list(draw_trials(16, 3, 30))
    trial = next(trial for trial in trials if trial.label == "slip")
    tally = Tally()
    tally.add(trial, 1)
    tally.add(trial, None)
    tally.add(trial, trial.slip_frame)
    assert (tally.false, tally.missed, tally.right) == (1, 1, 1)
    tally.add(next(trial for trial in trials if trial.label == "none"), None)
    assert tally.summary()["misses"] == wilson(1, 3), "only a slip can be missed"


@pytest.mark.slow
def test_slip_is_seen_on_true_fields_of_every_object():
    tally = Tally()
    for trial in draw_trials(16, 5, 30):
        tally.add(trial, alarm_of(true_fields(trial)))
    assert tally.right >= tally.trials - 1


@pytest.mark.parametrize("count", [1, pytest.param(8, marks=pytest.mark.slow)])
def test_displacements_are_within_the_limits_on_simulated_trials(count):
    """Length of the error vector, RMS over all markers of whole descents; `docs/slip_report.md` has more of them."""
    trials = [trial for trial in draw_trials(count, 1, 30) if trial.label == "slip"]
    assert trials
    for noise, limit_px in ((2.0, 0.06), (6.0, 0.10)):
        accuracy = accuracy_at_noise(trials, noise)
        assert np.sqrt(2) * accuracy["rms_px"] < limit_px
        assert accuracy["wrong_share"] < 0.001
        assert accuracy["tracked_share"] > 0.95


def test_bad_counts_are_refused(capsys):
    assert main(["slip-report", "--trials", "0"]) == 2
    assert "expected at least 1" in capsys.readouterr().err


@pytest.mark.slow
def test_the_report_is_written(tmp_path, monkeypatch):
    monkeypatch.setattr(tracking, "MEASURED_N", 1)
    assert main(["slip-report", "--trials", "8", "--out", str(tmp_path)]) == 0
    result = json.loads((tmp_path / "slip_report.json").read_text())
    assert result["tracking"]["noise_2"]["rms_px"] < result["tracking"]["noise_6"]["rms_px"]
    assert "| 2019 rule |" in (tmp_path / "slip_report.md").read_text()
