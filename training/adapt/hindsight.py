"""The errors of an insertion's attempts, drawn from all that its moves allow.

An object that went in may still have been off by what the gap leaves. All earlier attempts were off by that besides the
moves that followed (`errors_left`), and none of them went in. The release says how likely each such error was. Draws
from there (multiple imputation, Rubin 1987) teach and evaluate a network without taking its own moves for the truth.
"""

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from service.decision.outline import Outlines
from training.adapt.stages import trainer_of
from training.data.episodes import PROBE
from training.data.pressed import Pressed
from training.fit.checkpoint import Checkpoint
from training.networks.decider import Decider

DRAWS_N = 32
STEP = np.array([0.5, 1.0])
LEFT_X_MM, LEFT_THETA_DEG = np.arange(-3.5, 3.6, STEP[0]), np.arange(-12.0, 12.1, STEP[1])
"""What an object may be off by when it goes in."""
_LEFT = np.stack(np.meshgrid(LEFT_X_MM, LEFT_THETA_DEG, indexing="ij"), -1).reshape(-1, 2)
BLOCKED = 1e-6
"""Least chance of an attempt to be blocked."""


def drawn(release: Checkpoint, samples: Pressed, seed: int) -> Pressed:
    """The samples with `DRAWS_N` errors of each; those of a probe are all the one that is known."""
    draws = np.repeat(samples.error[:, None], DRAWS_N, axis=1)
    work, rng = samples.objects != PROBE, np.random.default_rng(seed)
    network: Decider = release.build()
    states = trainer_of(network, samples).states(np.arange(len(samples)), pictures=False)
    outlines = Outlines(LEFT_X_MM, release.expectations.tolerance, None)
    for name in np.unique(samples.groups[work]):
        rows = np.flatnonzero(samples.groups == name)
        log_chance = _log_likely(network, states[rows], samples.error[rows], release.joint_scales.temperature)
        entered = _log_entered(outlines, samples.error[rows].astype(np.float64))
        chance = np.exp(log_chance + entered - (log_chance + entered).max())
        left = _LEFT[rng.choice(len(_LEFT), DRAWS_N, p=chance / chance.sum())]
        draws[rows] += (left + rng.uniform(-0.5, 0.5, left.shape) * STEP).astype(np.float32)
    return replace(samples, error=draws[:, 0], draws=draws)


def _log_likely(
    network: Decider, states: torch.Tensor, moves: NDArray[np.float32], temperature: float
) -> NDArray[np.float64]:
    """[cells]: what the release makes of all attempts of an insertion, for each error that was left."""
    left = torch.as_tensor(_LEFT, dtype=torch.float32)
    with torch.inference_mode():
        lost = [
            network.density.negative_log_likelihood(state.expand(len(left), -1), left + torch.from_numpy(move))
            for state, move in zip(states, moves, strict=True)
        ]
        return np.asarray(-torch.stack(lost).double().sum(0) / temperature)


def _log_entered(outlines: Outlines, moves: NDArray[np.float64]) -> NDArray[np.float64]:
    """[cells]: chance that the object, off by that, was blocked in all attempts and then went in."""
    chance = outlines.chances(LEFT_X_MM, LEFT_THETA_DEG)
    for x_mm, theta_deg in moves:
        chance = chance * np.maximum(1.0 - outlines.chances(LEFT_X_MM + x_mm, LEFT_THETA_DEG + theta_deg), BLOCKED)
    return np.asarray(np.log(chance.mean(0).ravel() + np.finfo(float).tiny))
