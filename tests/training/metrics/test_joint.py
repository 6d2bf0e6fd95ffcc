import numpy as np
import pytest
import torch

from training.data.labels import CLASSES
from training.metrics.figures import cross_calibrated
from training.metrics.joint import Densities, density_temperature, normalised
from training.networks.density import GRID_THETA_DEG, GRID_X_MM, MixtureDensity


def gaussian(truth, sigma):
    x, theta = np.meshgrid(GRID_X_MM, GRID_THETA_DEG, indexing="ij")
    z2 = (x - truth[:, :1, None]) ** 2 + (theta - truth[:, 1:, None]) ** 2
    return -0.5 * z2 / sigma**2


def test_a_density_gives_its_mean_spread_and_class():
    truth = np.array([[8.0, -9.0], [-6.0, 0.2], [0.0, 0.0]], np.float32)
    predictions = Densities(gaussian(truth, 1.2), truth, np.array(["circle"] * 3)).predictions(1.0)
    assert np.allclose(predictions.error, truth, atol=0.05)
    assert np.allclose(np.exp(predictions.log_sigma), 1.2, atol=0.1)
    assert [CLASSES[i].name for i in predictions.logits.argmax(1)] == ["6", "1", "near"]


def test_the_temperature_undoes_overconfidence():
    rng = np.random.default_rng(0)
    centre = rng.uniform(-10, 10, (600, 2))
    truth = (centre + rng.normal(0, 2.0, centre.shape)).astype(np.float32)
    assert density_temperature(gaussian(centre, 1.4), truth) == pytest.approx(2.0, rel=0.2)


def test_no_trial_is_scored_by_a_calibration_that_saw_it():
    rng = np.random.default_rng(1)
    centre = rng.uniform(-8, 8, (40, 2))
    truth = (centre + rng.normal(0, 1.5, centre.shape)).astype(np.float32)
    groups, objects = np.repeat(["a", "b", "c", "d"], 10), np.array(["circle"] * 40)
    own = np.isin(groups, ["a", "c"])
    predictions = cross_calibrated(Densities(gaussian(centre, 1.4), truth, objects), groups)
    elsewhere = np.where(own[:, None], -truth, truth)  # changed truths of one half move the other half alone
    moved = cross_calibrated(Densities(gaussian(centre, 1.4), elsewhere, objects), groups)
    assert np.array_equal(predictions.log_sigma[own], moved.log_sigma[own])
    assert not np.allclose(predictions.log_sigma[~own], moved.log_sigma[~own])
    assert np.array_equal(predictions.truth, truth.astype(np.float64))


def test_the_grid_agrees_with_the_likelihood_that_trained_it():
    torch.manual_seed(0)
    head, state = MixtureDensity(16), torch.randn(3, 16)
    with torch.no_grad():
        cells = normalised(head.on_grid(state).double().numpy(), 1.0)
        error = torch.tensor([[4.0, 3.5]]).repeat(3, 1)
        wanted = np.exp(-head.negative_log_likelihood(state, error).numpy()) / 25  # per mm deg
    density = cells[:, GRID_X_MM.index(4.0), GRID_THETA_DEG.index(3.5)]
    assert density == pytest.approx(wanted, rel=0.35)  # mass beyond the grid is not on it
