"""Evidence from a network's outputs, checked against plain statistics of the underlying density."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from service.contract import ModelCard
from service.decision.evidence import Density, Evidence, Refusal, check_strangeness, from_joint, from_pair
from tests.service import tiny_models

GRID_X_MM, GRID_THETA_DEG = np.linspace(-20, 20, 161), np.linspace(-24, 24, 193)
MEAN, SIGMA = (3.0, -4.0), (1.5, 2.5)


def joint_card(temperature: float = 1.0) -> ModelCard:
    return tiny_models.card(
        "joint",
        "step",
        grid_x_mm=tuple(GRID_X_MM),
        grid_theta_deg=tuple(GRID_THETA_DEG),
        calibration={"temperature": temperature, "sigma_scale_x": 1.2, "sigma_scale_theta": 0.8},
    )


def joint_evidence(temperature: float = 1.0) -> Evidence:
    off = ((GRID_X_MM - MEAN[0]) / SIGMA[0])[:, None], ((GRID_THETA_DEG - MEAN[1]) / SIGMA[1])[None]
    return from_joint(joint_card(temperature), {"log_density": -0.5 * (off[0] ** 2 + off[1] ** 2)[None]})


@pytest.mark.parametrize("temperature", [1.0, 2.0])
def test_a_joint_density_states_its_mean_and_its_calibrated_standard_deviation(temperature: float) -> None:
    evidence = joint_evidence(temperature)
    wider = np.sqrt(temperature)
    assert evidence.error == pytest.approx(MEAN, abs=1e-3)
    assert evidence.sigma == pytest.approx((1.2 * SIGMA[0] * wider, 0.8 * SIGMA[1] * wider), rel=1e-3)


def test_a_joint_density_on_a_single_cell_is_sure_to_a_micrometre_and_not_beyond() -> None:
    certain = np.full((1, len(GRID_X_MM), len(GRID_THETA_DEG)), -1e3)
    certain[0, 20, 30] = 0.0
    evidence = from_joint(joint_card(), {"log_density": certain})
    assert evidence.error == pytest.approx((GRID_X_MM[20], GRID_THETA_DEG[30]))
    assert evidence.sigma == (1e-3, 1e-3)


def test_a_classs_probability_is_the_share_of_draws_on_its_side() -> None:
    x_mm, theta_deg = np.random.default_rng(0).normal(MEAN, SIGMA, (100_000, 2)).T
    evidence = joint_evidence()
    draws = np.sign(x_mm) * (abs(x_mm) > 2.5), np.sign(theta_deg) * (abs(theta_deg) > 5)
    for entry, probability in zip(evidence.classes, evidence.probabilities, strict=True):
        share = np.mean((draws[0] == entry.sign_x) & (draws[1] == entry.sign_theta))
        assert probability == pytest.approx(share, abs=0.05)  # a cell on the edge belongs to one side as a whole
    assert evidence.probabilities.sum() == pytest.approx(1)
    assert evidence.best.name == "2"


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("where", ["probability", "error", "sigma", "density"])
def test_no_evidence_is_made_of_numbers_that_are_not_finite(where: str, bad: float) -> None:
    values = {name: np.array([bad if name == where else 0.5]) for name in ("probability", "error", "sigma", "density")}
    density = Density(GRID_X_MM, GRID_THETA_DEG, np.full((161, 193), values["density"][0]))
    numbers = (float(values["error"][0]), 0.5), (float(values["sigma"][0]), 0.5)
    with pytest.raises(Refusal, match="finite"):
        Evidence(tiny_models.CLASSES, np.full(9, values["probability"][0]), *numbers, density)


def test_the_interval_on_the_wire_holds_nine_errors_of_ten_where_the_sigma_is_true() -> None:
    estimate = Evidence(tiny_models.CLASSES, np.full(9, 1 / 9), (3.0, -4.0), (1.5, 2.5)).estimate()
    for (low, high), centre, sigma in (
        (estimate.interval_x_mm, 3.0, 1.5),
        (estimate.interval_theta_deg, -4.0, 2.5),
    ):
        assert math.erf((high - centre) / sigma / math.sqrt(2.0)) == pytest.approx(0.9, abs=1e-9)
        assert centre - low == pytest.approx(high - centre)
    assert Evidence(tiny_models.CLASSES, np.full(9, 1 / 9), (3.0, -4.0)).estimate().interval_x_mm is None


@pytest.mark.parametrize(("temperature", "scale"), [(1.0, 1.0), (2.0, 0.5)])
def test_two_networks_are_calibrated_by_their_own_cards(temperature: float, scale: float) -> None:
    direction = tiny_models.card("direction", "step", calibration={"temperature": temperature})
    sizes = {"sigma_scale_x": scale, "sigma_scale_theta": 3.0}
    magnitude = tiny_models.card("magnitude", "step", calibration=sizes)
    logits = np.log(np.arange(1.0, 10.0))[None]
    moments = {"error": np.array([[2.0, -3.0]]), "log_sigma": np.log([[1.5, 2.0]])}
    evidence = from_pair(direction, magnitude, {"logits": logits}, moments)
    weights = np.arange(1.0, 10.0) ** (1 / temperature)
    assert evidence.probabilities == pytest.approx(weights / weights.sum())
    assert evidence.error == (2.0, -3.0)
    assert evidence.sigma == pytest.approx((1.5 * scale, 6.0))


@pytest.mark.parametrize("log_sigma", [-1e3, 1e3, float("nan")])
def test_a_sigma_of_nothing_or_of_everything_is_refused(log_sigma: float) -> None:
    cards = [tiny_models.card(role, "step") for role in ("direction", "magnitude")]
    moments = {"error": np.zeros((1, 2)), "log_sigma": np.array([[0.0, log_sigma]])}
    with pytest.raises(Refusal, match="the magnitude network gave a sigma"):
        from_pair(*cards, {"logits": np.zeros((1, 9))}, moments)


@pytest.mark.parametrize(("strange", "known"), [(4.0, True), (4.1, False), (float("nan"), False)])
def test_what_is_stranger_than_the_card_allows_is_refused(strange: float, known: bool) -> None:
    card: Any = SimpleNamespace(pressing=SimpleNamespace(strangeness_limit=4.0))
    outputs = {"strangeness": np.array([[strange]])}
    if known:
        check_strangeness(card, outputs)
    else:
        with pytest.raises(Refusal, match="strangeness"):
            check_strangeness(card, outputs)
