import numpy as np
import pytest

from training.data.labels import CLASSES, class_of
from training.metrics.figures import (
    Predictions,
    cross_calibrated,
    expected_calibration_error,
    figures,
    probabilities,
)


def make(count=4000, temperature=1.0, sigma_factor=1.0, seed=0):
    """Predictions of an honest oracle, its logits and sigmas then distorted."""
    rng = np.random.default_rng(seed)
    truth = rng.uniform(-15, 15, (count, 2))
    sigma = rng.uniform(0.5, 3, (count, 2))
    error = truth + rng.normal(size=(count, 2)) * sigma
    logits = rng.normal(0, 1.5, (count, len(CLASSES)))
    p = probabilities(logits, 1.0)
    labels = (p.cumsum(1) > rng.random((count, 1))).argmax(1)
    wanted = class_of(truth.astype(np.float32))
    shift = (wanted - labels)[:, None]
    logits = np.take_along_axis(logits, (np.arange(len(CLASSES)) - shift) % len(CLASSES), 1)
    return Predictions(logits * temperature, error, np.log(sigma / sigma_factor), truth, np.full(count, "rectangle"))


@pytest.mark.parametrize("temperature", [0.6, 1.0, 2.0])
def test_calibration_finds_a_known_temperature(temperature):
    assert make(temperature=temperature).calibration().temperature == pytest.approx(temperature, rel=0.1)


@pytest.mark.parametrize("factor", [0.5, 1.0, 3.0])
def test_calibration_finds_known_sigma_scales(factor):
    scales = make(sigma_factor=factor).calibration()
    assert scales.sigma_x == pytest.approx(factor, rel=0.06)
    assert scales.sigma_theta == pytest.approx(factor, rel=0.06)


def test_calibrated_intervals_cover_what_they_say_on_fresh_trials():
    scales = make(sigma_factor=2.0, seed=1).calibration()
    table = figures(make(sigma_factor=2.0, seed=2).rescaled(scales))
    assert table["coverage90_x"] == pytest.approx(0.9, abs=0.02)
    assert table["ece"] < 0.03


@pytest.mark.parametrize("count", [10, 20, 50])
def test_intervals_calibrated_on_a_few_probes_hold_nine_tenths_of_further_errors(count):
    held = [
        figures(make(200, seed=seed + 1000).rescaled(make(count, seed=seed).calibration()))["coverage90_x"]
        for seed in range(400)
    ]
    assert np.mean(held) == pytest.approx(0.905, abs=0.01)  # split conformal: 0.9 to 0.9 + 1 / (count + 1), on average


def test_an_overconfident_network_has_a_large_calibration_error():
    predictions = make(temperature=4.0)
    labels = class_of(predictions.truth.astype(np.float32))
    assert expected_calibration_error(probabilities(predictions.logits, 1.0), labels) > 0.1


def test_a_perfect_network_has_no_error():
    truth = np.random.default_rng(0).uniform(-15, 15, (200, 2))
    logits = 50.0 * np.eye(len(CLASSES))[class_of(truth.astype(np.float32))]
    table = figures(Predictions(logits, truth, np.zeros_like(truth), truth, np.full(200, "circle")))
    assert table["accuracy"] == 1
    assert table["wrong_side_x"] == table["mae_x_mm"] == table["rmse_theta_deg"] == 0


def test_cross_calibration_keeps_the_order_and_the_coverage():
    predictions = make(sigma_factor=2.0)
    fair = cross_calibrated(predictions, np.arange(len(predictions.truth)).astype(str))
    assert np.array_equal(fair.truth, predictions.truth)
    assert figures(fair)["coverage90_x"] == pytest.approx(0.9, abs=0.02)
