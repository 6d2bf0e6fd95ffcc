"""The best of several stages has to be better than one that was tried alone."""

import numpy as np
import pytest

from service.contract import Sensor
from service.contract.shipped import released_models
from tests.training.data.test_episodes import recorded
from training.adapt.adapt import compare
from training.data.episodes import read_episodes
from training.data.labels import class_of
from training.fit.checkpoint import Checkpoint
from training.metrics.figures import Predictions

PROBES_N = 60
BETTER = np.random.default_rng(2).permutation(PROBES_N) < PROBES_N // 2
OTHERS = ("gain", "around")


def predicted(scales, spread, known_of):
    """Predictions of the right direction, off by ``spread`` [N] times what they state, calibrated by ``scales``.

    ``known_of`` [N]: what the errors are known from.
    """
    truth = np.random.default_rng(0).uniform(-12, 12, (len(spread), 2))
    off = 2.0 * spread[:, None] * np.random.default_rng(1).normal(size=truth.shape)
    logits = 4.0 * scales.temperature * np.eye(9)[class_of(truth.astype(np.float32))]
    sigma = 2.0 / np.array([scales.sigma_x, scales.sigma_theta])
    return Predictions(logits, truth + off, np.log(sigma) + np.zeros_like(truth), truth, known_of)


def choice(root, spreads, *, work=False, probes_n=0):
    """The comparison of stages whose predictions are off by their ``spreads`` [N] times what they state.

    The first ``probes_n`` samples are of probes even if the rest is of ``work``.
    """
    count = len(spreads["released"])
    recorded(root, probes_n, seed=1)
    samples = read_episodes(recorded(root, count - probes_n, work=work, first=probes_n), Sensor.load())
    release = Checkpoint.load(released_models() / "checkpoint.pt")
    made = {stage: predicted(release.scales, one, samples.objects) for stage, one in spreads.items()}
    return compare(release, samples, {stage: (one, one) for stage, one in made.items()}, 0)


@pytest.mark.parametrize(
    ("spread", "others", "accepted"),
    [
        (np.where(BETTER, 0.5, 1.15), (), True),
        (np.where(BETTER, 0.5, 1.15), ("all", "around"), False),
        (np.full(PROBES_N, 0.5), ("all", "around"), True),
    ],
    ids=["a gain in half of all probes, one stage", "the same, the best of three", "a gain in all probes"],
)
def test_the_best_of_three_needs_a_surer_gain_than_a_single_stage(tmp_path, spread, others, accepted):
    worse = dict.fromkeys(others, np.full(PROBES_N, 1.5))
    comparison = choice(tmp_path, {"released": np.ones(PROBES_N), "gain": spread, **worse})
    assert comparison.best == "gain"
    assert comparison.accepted == accepted


@pytest.mark.parametrize(
    ("count", "better", "spread", "work", "accepted"),
    [
        (100, "all", (0.5, 1.3), False, True),
        (99, "all", (0.5, 1.3), False, False),
        (100, "gain", (0.5, 1.3), False, False),
        (100, "all", (0.6, 1.15), True, False),
    ],
    ids=["all weights, many probes", "one probe fewer", "another stage", "all weights, as many insertions"],
)
def test_many_probes_let_all_weights_pass_with_a_gain_too_small_for_any_other_stage(
    tmp_path, count, better, spread, work, accepted
):
    half = np.random.default_rng(1).permutation(count) < count // 2
    others = dict.fromkeys(("all", *OTHERS), np.full(count, 1.5))
    gain = np.where(half, *spread)
    comparison = choice(tmp_path, {"released": np.ones(count), **others, better: gain}, work=work)
    assert comparison.best == better
    assert comparison.accepted == accepted


@pytest.mark.parametrize("work", [False, True])
@pytest.mark.parametrize(
    ("off", "accepted", "why"),
    [(1.5, True, ""), *((off, False, "no stage is likelier") for off in (1.1, 1.0, 0.5))],
    ids=["too sure", "too sure, maybe by chance", "as sure as it may be", "not sure enough"],
)
def test_a_release_that_is_proven_too_sure_becomes_less_sure_and_never_surer(tmp_path, off, accepted, why, work):
    """It stays the same network: the same directions, the same estimates."""
    off = np.full(PROBES_N, off)
    comparison = choice(tmp_path, {"released": off, "calibration": off}, work=work)
    assert comparison.accepted == accepted
    assert why in "".join(comparison.objections)
    was, now = (comparison.figures[stage] for stage in ("released", "calibration"))
    assert now["accuracy"] == was["accuracy"]
    assert now["mae_x_mm"] == was["mae_x_mm"]
    assert now["coverage90_x"] >= was["coverage90_x"]


def test_a_stage_with_a_proven_gain_comes_before_calibration(tmp_path):
    off = np.full(PROBES_N, 1.5)
    comparison = choice(tmp_path, {"released": off, "calibration": off, "gain": np.full(PROBES_N, 0.7)})
    assert comparison.accepted
    assert comparison.best == "gain"


@pytest.mark.parametrize(
    ("probes_n", "best", "compared_n"),
    [(30, "gain", 30), (20, "gain", 20), (19, "all", 60)],
    ids=["probes", "just enough probes", "too few probes"],
)
def test_work_judges_no_network_where_there_are_probes_enough(tmp_path, probes_n, best, compared_n):
    """`gain` does better on the probes, `all` on the errors that work only bounds."""
    probe = np.arange(PROBES_N) < probes_n
    stages = {"gain": np.where(probe, 0.5, 2.0), "all": np.where(probe, 2.0, 0.5)}
    comparison = choice(tmp_path, {"released": np.ones(PROBES_N), **stages}, work=True, probes_n=probes_n)
    likeliest = min(("gain", "all"), key=lambda stage: comparison.figures[stage]["likelihood"])
    assert likeliest == best
    assert comparison.samples_n == compared_n
