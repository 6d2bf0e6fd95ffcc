"""The stages of fitting a network to a cell, from a few numbers to all weights; each is calibrated afterwards.

A few probes carry little information, so every stage is pulled to the release: the scales as by a number of further
samples, the weights by their squared distance (L2-SP, Li et al. 2018).
"""

from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from training.config import DataConfig, RunConfig, StageConfig
from training.data.episodes import PROBE
from training.data.pressed import Pressed
from training.fit.checkpoint import Checkpoint
from training.fit.train import Trainer
from training.metrics.figures import Predictions, Scales, joined
from training.metrics.joint import Densities
from training.networks.decider import ERROR_SCALE, Decider

Rows = NDArray[np.int64]
StageName = Literal["released", "calibration", "gain", "all", "around"]
STAGES: tuple[StageName, ...] = ("released", "calibration", "gain", "all", "around")
PULL_N, WEIGHTS_PULL_N, SCALES_PULL_N = 20, 5, 5
"""Weight of the release in samples of the cell: in gains, in weights, and in the few scales."""
MOST_EPOCHS, SAMPLES_N = 60, 9000
"""Epochs with few samples, and total passes over samples with many; at least 18 epochs."""
FOLDS = 5
BATCH, RATE = 32, 1e-3


def trainer_of(network: Decider, samples: Pressed) -> Trainer:
    """The trainer that computes losses and predictions of a network on samples."""
    config = RunConfig(name="adapt", data=DataConfig(path="-"), trunk=StageConfig(epochs=0))
    return Trainer(config, samples, network, torch.zeros(2, 3))


def held_out(
    stage: StageName, release: Checkpoint, samples: Pressed, seed: int, presses: Pressed | None = None
) -> tuple[Predictions, Densities]:
    """A stage's prediction of each sample, fitted without its fixture; not calibrated."""
    if stage == "around":
        trainer = trainer_of(fit_around(release, presses, seed), samples)
        rows = np.arange(len(samples))
        return trainer.predict(rows, pictures=False), trainer.predict_density(rows, pictures=False)
    parts, densities, folds = [], [], folds_of(samples.groups, seed)
    for held in folds:
        others = np.setdiff1d(np.arange(len(samples)), held)
        trainer = trainer_of(fit_stage(stage, release, samples, others, seed), samples)
        parts.append(trainer.predict(held, pictures=False))
        densities.append(trainer.predict_density(held, pictures=False))
    return joined(parts, folds), joined(densities, folds)


def folds_of(groups: NDArray[np.str_], seed: int) -> list[Rows]:
    """Rows of each fold; a fixture is never split."""
    names = np.unique(groups)
    np.random.default_rng(seed).shuffle(names)
    return [np.flatnonzero(np.isin(groups, part)) for part in np.array_split(names, FOLDS)]


def calibrated(stage: StageName, scales: Scales, sample: Predictions | Densities) -> Scales:
    """Scales that fit the predictions of held-out samples, pulled to the release's.

    Calibration alone makes a network no surer, as it proves no gain. Nor does work, also with a few probes beside it.
    The error of a working insertion is known only to within the gap's clearance; where it was in there is the release's
    own opinion.
    """
    hindsight = bool((sample.objects != PROBE).any())
    fitted, share = sample.calibration(), _share(len(sample.objects), SCALES_PULL_N)

    def pulled(name: str) -> float:
        was = float(getattr(scales, name))
        scale = float(was ** (1.0 - share) * getattr(fitted, name) ** share)
        return max(was, scale) if hindsight or stage == "calibration" else scale

    return Scales(pulled("temperature"), pulled("sigma_x"), pulled("sigma_theta"))


def _share(count: int, pull_n: int = PULL_N) -> float:
    return count / (count + pull_n)


def fit_stage(stage: StageName, release: Checkpoint, samples: Pressed, rows: Rows, seed: int) -> Decider:
    """The release after one stage on the chosen samples, before calibration."""
    network: Decider = release.build()
    if stage == "gain":
        _scale_errors(network, samples, rows)
    if stage == "all":
        _tune(network, samples, rows, seed)
    return network.eval()


def fit_around(release: Checkpoint, presses: Pressed | None, seed: int) -> Decider:
    """The release with all weights fitted to simulated presses around the cell; not calibrated."""
    assert presses is not None
    return fit_stage("all", release, presses, np.arange(len(presses)), seed)


def _scale_errors(network: Decider, samples: Pressed, rows: Rows) -> None:
    """Scale the heads' error by the gain that fits and add the offset; pulled to 1 and 0."""
    predictions = trainer_of(network, samples).predict(rows, pictures=False)
    share = _share(len(rows))
    with torch.no_grad():
        for axis in range(2):
            x, y = predictions.error[:, axis], predictions.truth[:, axis]
            gain = 1.0 + share * (float(np.cov(x, y)[0, 1] / max(np.var(x, ddof=1), 1e-6)) - 1.0)
            offset = share * float(np.mean(y - gain * x))
            network.magnitude.weight[axis] *= gain
            network.magnitude.bias[axis] = network.magnitude.bias[axis] * gain + offset / ERROR_SCALE
            parts = slice(1 + axis, None, 5)  # means of the mixture's components
            network.density.parts.weight[parts] *= gain
            network.density.parts.bias[parts] = network.density.parts.bias[parts] * gain + offset / ERROR_SCALE


def _tune(network: Decider, samples: Pressed, rows: Rows, seed: int) -> None:
    """Train a few epochs with symmetries and disturbances; trunk and heads are pulled to their start values."""
    torch.manual_seed(seed)
    network.requires_grad_(requires_grad=False)
    parts = (network.trunk, network.direction, network.magnitude, network.density)
    parameters = [parameter.requires_grad_() for part in parts for parameter in part.parameters()]
    rng, trainer = np.random.default_rng(seed), trainer_of(network, samples)
    start = [parameter.detach().clone() for parameter in parameters]
    epochs = max(18, min(MOST_EPOCHS, SAMPLES_N // len(rows)))
    optimiser = torch.optim.Adam(parameters, lr=RATE)
    total = epochs * -(-len(rows) // BATCH)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=total, pct_start=0.1)
    network.train()
    for _ in range(epochs):
        order = rng.permutation(rows)
        for begin in range(0, len(order), BATCH):
            batch = samples.batch(order[begin : begin + BATCH], rng)
            pull = sum((now - was).square().sum() for now, was in zip(parameters, start, strict=True))
            loss = trainer.trunk_loss(batch) + WEIGHTS_PULL_N / len(rows) * pull
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            nn.utils.clip_grad_norm_(parameters, 1.0)
            optimiser.step()
            schedule.step()
    network.eval()
