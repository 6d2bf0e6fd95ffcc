"""What the probes of one grasp have in common errs alike in all of them: a few grasps prove as little as few probes."""

import numpy as np
import pytest

from training.adapt.frames import ZERO, find_gap
from training.adapt.objections import to_gain, to_wider
from training.data.labels import class_of
from training.metrics.figures import Predictions

PROBES_N = 5


def predictions(log_sigma, off=0.0):
    """Predictions of no error but ``off`` [N], so that a change of ``log_sigma`` [N] is all that changes their loss."""
    truth = np.random.default_rng(0).uniform(-12, 12, (len(log_sigma), 2))
    logits = 9.0 * np.eye(9)[class_of(truth.astype(np.float32))]
    columns = np.column_stack([np.full(len(log_sigma), off)] * 2)
    return Predictions(logits, truth + columns, np.column_stack([log_sigma] * 2), truth, np.full(len(truth), "probe"))


def grasps_of(count, probes_n=PROBES_N):
    return np.repeat([f"{grasp:02d}" for grasp in range(count)], probes_n)


@pytest.mark.parametrize("grasps_n", [5, 12])
def test_a_gain_that_is_chance_is_taken_for_one_as_rarely_as_stated_with_few_grasps(grasps_n):
    rng, chance, runs_n = np.random.default_rng(1), 0.05, 200
    count = grasps_n * PROBES_N
    before, groups = predictions(np.zeros(count)), grasps_of(grasps_n)
    accepted_n = 0
    for run in range(runs_n):
        worse = np.repeat(rng.normal(size=grasps_n), PROBES_N) + rng.normal(size=count)
        accepted_n += not any("likelier" in one for one in to_gain(before, predictions(worse), groups, run, chance))
    assert accepted_n / runs_n <= 1.5 * chance


def test_fifty_probes_of_ten_grasps_can_still_prove_a_gain():
    rng = np.random.default_rng(2)
    better = -0.5 + np.repeat(0.3 * rng.normal(size=10), PROBES_N) + rng.normal(0.0, 0.3, 50)
    assert not list(to_gain(predictions(np.zeros(50)), predictions(better), grasps_of(10), 0, 0.05 / 3))


@pytest.mark.parametrize(("probes_n", "objections_n"), [(1, 0), (PROBES_N, 1)], ids=["each its own grasp", "five each"])
def test_intervals_that_miss_every_error_of_a_few_grasps_may_do_so_by_chance(probes_n, objections_n):
    missed = np.arange(60) < 15
    before = predictions(np.where(missed, -3.0, 3.0), off=1.0)
    groups = grasps_of(60 // probes_n, probes_n)
    assert len(list(to_wider(before, groups))) == objections_n


def test_the_sigma_of_the_gap_holds_what_a_grasp_has_in_common(monkeypatch):
    monkeypatch.setattr("training.adapt.frames.ZERO", np.zeros(2))
    rng, held_n, runs_n = np.random.default_rng(3), 0, 200
    groups = grasps_of(12)
    for _ in range(runs_n):
        stated = rng.uniform(-12, 12, (60, 2))
        hangs = np.repeat(rng.normal(size=(12, 2)), PROBES_N, axis=0)
        gap = find_gap(stated, stated + hangs + rng.normal(0.0, 0.3, stated.shape), groups)
        held_n += abs(gap.at[0]) < 1.96 * gap.sigma[0]
    assert held_n >= 0.9 * runs_n
    alone = find_gap(stated, stated + rng.normal(0.0, 0.3, stated.shape), groups)
    assert find_gap(stated, stated + 1.0, np.full(60, "one")).at == pytest.approx((-1.0, -1.0), abs=0.1)
    assert alone.sigma[0] < 0.5 * gap.sigma[0]


def test_no_number_of_probes_tells_the_gap_better_than_the_zero_of_the_release():
    stated = np.random.default_rng(5).uniform(-15, 15, (1000, 2))
    assert np.all(np.array(find_gap(stated, stated, grasps_of(1000, 1)).sigma) > 0.95 * ZERO)
