"""Errors of work are drawn from what its moves allow: one remainder of each insertion, that fits and was not tried."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from service.contract import Sensor
from service.contract.shipped import released_models
from service.decision.outline import SOFT_MM
from tests.training.data.test_episodes import keep, recorded, steps_of
from training.adapt.hindsight import STEP, drawn
from training.data.episodes import LATER, read_episodes
from training.fit.checkpoint import Checkpoint

CLEARANCE_MM = 2.0


@pytest.fixture(scope="module")
def release():
    return Checkpoint.load(released_models() / "checkpoint.pt")


def claiming(release, at=(0.0, 0.0), spread=20.0):
    """The release, but all components of its density are at ``at`` (mm, deg), wide by ``spread``: it feels nothing."""
    weights = {name: value.clone() for name, value in release.weights.items()}
    weights["density.parts.weight"] *= 0.0
    bias = weights["density.parts.bias"].view(-1, 5)
    bias[:, 1:3], bias[:, 3:] = torch.tensor(at) / 5.0, np.log(spread / 5.0)
    return replace(release, weights=weights)


def insertions(root, *all_moves):
    rng = np.random.default_rng(0)
    for number, moves in enumerate(all_moves):
        shown = [(steps_of(1, 1, rng), {"dx_mm": x_mm, "dtheta_deg": deg}) for x_mm, deg in moves]
        keep(root / f"w{number}", shown, "insert", "inserted", 0.0, 0.0)
    return read_episodes(root, Sensor.load())


def left_in(samples, hindsight):
    return samples.draws - hindsight.error[:, None]


def test_what_is_known_of_a_probe_stays_as_it_is(release, tmp_path):
    probes = read_episodes(recorded(tmp_path, 5), Sensor.load())
    samples = drawn(release, probes, 0)
    assert (samples.draws == probes.error[:, None]).all()
    assert (samples.error == probes.error).all()


def test_all_attempts_of_an_insertion_share_what_was_left(release, tmp_path):
    hindsight = insertions(tmp_path, [(-9.0, 5.0), (-4.0, -6.0)], [(8.0, 0.0), (0.5, 9.0), (-3.0, 2.0)])
    samples = drawn(release, hindsight, 0)
    assert (hindsight.objects == LATER).sum() == 3
    left = left_in(samples, hindsight)
    for name in ("w0", "w1"):
        mine = left[hindsight.groups == name]
        assert mine == pytest.approx(np.broadcast_to(mine[:1], mine.shape), abs=1e-5)
        assert np.ptp(mine[0], axis=0).min() > 0.5
    assert (samples.error == samples.draws[:, 0]).all(), "evaluated on one draw of each"


def test_a_network_that_feels_nothing_fills_what_fits_and_no_more(release, tmp_path):
    hindsight = insertions(tmp_path, *[[(-9.0, 8.0)]] * 20)
    left = left_in(drawn(claiming(release, (9.0, -8.0)), hindsight, 0), hindsight)
    x_mm, theta_deg = np.abs(left).reshape(-1, 2).T
    assert x_mm.max() < CLEARANCE_MM + 5.0 * SOFT_MM + STEP[0]
    assert np.quantile(x_mm, 0.9) > 0.6 * CLEARANCE_MM
    assert np.quantile(theta_deg, 0.9) > 3.5
    assert left.mean((0, 1)) == pytest.approx([0.0, 0.0], abs=0.5)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_network_that_is_sure_moves_the_error_only_as_far_as_the_gap_allows(release, tmp_path, side):
    """It said 12 mm, and 9 mm were enough: the error was nearer to 11 than to 9. Saying 30 mm makes it no 12."""
    hindsight = insertions(tmp_path, *[[(-9.0 * side, 0.0)]] * 10)
    for claim_mm in (12.0, 30.0):
        left = left_in(drawn(claiming(release, (claim_mm * side, 0.0), 1.0), hindsight, 0), hindsight)
        assert 1.0 < side * left[..., 0].mean() < CLEARANCE_MM + 5.0 * SOFT_MM
    agreed = left_in(drawn(claiming(release, (9.0 * side, 0.0), 0.2), hindsight, 0), hindsight)
    assert np.abs(agreed[..., 0]).max() < 1.0


def test_where_it_was_blocked_it_was_not(release, tmp_path):
    """Blocked 1.5 mm beside where it went in: it was not off to that side by as much."""
    near, far = (insertions(tmp_path / str(x_mm), *[[(-x_mm, 0.0)]] * 20) for x_mm in (1.5, 9.0))
    samples = drawn(claiming(release), near, 0)
    left_far = left_in(drawn(claiming(release, (9.0, 0.0)), far, 0), far)

    def would_fit(errors):
        return (np.abs(errors) < (0.5 * CLEARANCE_MM, 3.0)).all(-1).mean()

    assert would_fit(samples.draws) < 0.3 * would_fit(near.error[:, None] + left_far)
    assert left_in(samples, near)[..., 0].mean() > 0.3


def test_the_same_seed_draws_the_same_and_a_batch_draws_from_all(release, tmp_path):
    hindsight = insertions(tmp_path, [(-9.0, 5.0)], [(3.0, 6.0)])
    one, again, other = (drawn(release, hindsight, seed) for seed in (0, 0, 1))
    assert (one.draws == again.draws).all()
    assert (one.draws != other.draws).any()
    rows, rng = np.arange(len(one)), np.random.default_rng(0)
    assert (one.batch(rows, None).error.numpy() == one.error).all()
    batches = np.stack([np.abs(one.batch(rows, rng).error.numpy()) for _ in range(50)])
    assert len(np.unique(batches[:, 0, 0])) > 10
    assert np.isin(batches[:, 0, 0], np.abs(one.draws[0, :, 0])).all()
