"""The best of several stages has to be better than one that was tried alone."""

import numpy as np
import pytest

from service.contract import Sensor
from service.contract.shipped import released_models
from tests.training.adapt.test_adapt import recorded
from training.adapt.adapt import compare
from training.data.episodes import read_episodes
from training.data.labels import class_of
from training.fit.checkpoint import Checkpoint
from training.metrics.figures import Predictions

PROBES_N = 60
TRUTH = np.random.default_rng(0).uniform(-12, 12, (PROBES_N, 2))
BETTER = np.random.default_rng(2).permutation(PROBES_N) < PROBES_N // 2


def predicted(scales, spread):
    """Predictions of the right direction, off by ``spread`` [N] times what they state, calibrated by ``scales``."""
    off = 2.0 * spread[:, None] * np.random.default_rng(1).normal(size=TRUTH.shape)
    logits = 4.0 * scales.temperature * np.eye(9)[class_of(TRUTH.astype(np.float32))]
    sigma = 2.0 / np.array([scales.sigma_x, scales.sigma_theta])
    return Predictions(logits, TRUTH + off, np.log(sigma) + np.zeros_like(TRUTH), TRUTH, np.full(PROBES_N, "probe"))


@pytest.mark.parametrize(
    ("spread", "others", "accepted"),
    [
        (np.where(BETTER, 0.5, 1.15), (), True),
        (np.where(BETTER, 0.5, 1.15), ("calibration", "all", "around"), False),
        (np.full(PROBES_N, 0.5), ("calibration", "all", "around"), True),
    ],
    ids=["a gain in half of all probes, one stage", "the same, the best of four", "a gain in all probes"],
)
def test_the_best_of_four_needs_a_surer_gain_than_a_single_stage(tmp_path, spread, others, accepted):
    samples = read_episodes(recorded(tmp_path, PROBES_N), Sensor.load())
    release = Checkpoint.load(released_models() / "checkpoint.pt")
    stages = {"released": np.ones(PROBES_N), "gain": spread, **dict.fromkeys(others, np.full(PROBES_N, 1.5))}
    held = {stage: (one, one) for stage in stages for one in [predicted(release.scales, stages[stage])]}
    comparison = compare(release, samples, held, 0)
    assert comparison.best == "gain"
    assert comparison.accepted == accepted
