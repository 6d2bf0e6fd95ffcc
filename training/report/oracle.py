"""The information limit: a decision from the true rigid motion of the object in the hand.

A perfect reader of the gel knows how the object moved in the fingers and no more. A recurrent network of the same size
reads that motion (6 degrees of freedom, exact) beside gap width and grasp height. How well it decides is the limit of
any tactile network.
"""

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from training.config import JITTER, StageConfig
from training.data.batches import blurred_geometry
from training.data.dataset import SPLITS, Trials
from training.data.labels import CLASSES, HALF_TURN_SIGNS, MIRROR_SIGNS, class_of
from training.fit.loop import Stage, fit
from training.metrics.figures import Predictions, by_split
from training.networks.decider import ERROR_SCALE, geometry_features
from training.networks.settings import FRAMES_PER_DECISION

STAGE = StageConfig(epochs=60, batch=64, learning_rate=3e-3, patience=15)
# Hand frame: place x, y, z in mm, turn about x, y, z in rad
MIRRORED = np.array([-1, 1, 1, 1, -1, -1], np.float32)
HALF_TURNED = np.array([-1, -1, 1, -1, -1, 1], np.float32)
Floats = NDArray[np.float32]


class MotionOracle(nn.Module):
    """True in-hand motion [B, T, 6] since the first frame, and what else is known [B, told] -> decision state."""

    spread: Tensor

    def __init__(self, spread: Tensor, told: int = 3, width: int = 128) -> None:
        super().__init__()
        self.read = nn.Sequential(nn.Linear(6, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU())
        self.cell = nn.GRUCell(width + told, width)
        self.direction = nn.Linear(width, len(CLASSES))
        self.magnitude = nn.Linear(width, 4)
        self.register_buffer("spread", spread)

    def forward(self, motion: Tensor, told: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Class logits, error in (mm, deg) and its log sigma."""
        features = self.read(motion / self.spread)
        state = torch.zeros(len(motion), self.cell.hidden_size)
        for step in range(motion.shape[1]):
            state = self.cell(torch.cat([features[:, step], told], 1), state)
        out = self.magnitude(state)
        return self.direction(state), out[:, :2] * ERROR_SCALE, out[:, 2:].clamp(-4.0, 4.0)


def oracle_figures(trials: Trials, folder: Path, seed: int = 0) -> dict[str, dict[str, float]]:
    """Rows "validation/..." and "test/..." of the oracle, scored as networks are; trained once, kept in ``folder``."""
    torch.manual_seed(seed)
    chosen, held = trials.of("train"), trials.of("validation")
    motion = _cut(trials, chosen, np.full(len(chosen), JITTER))
    oracle = MotionOracle(torch.from_numpy(motion.std((0, 1)) + 1e-6))

    def loss(batch: tuple[Tensor, Tensor, Tensor]) -> Tensor:
        motion, geometry, error = batch
        return loss_of(oracle(motion, geometry_features(geometry)), error)

    def validate() -> dict[str, float]:
        with torch.inference_mode():
            return {"score": float(loss(_whole(trials, held)))}

    stage = Stage(
        "oracle",
        STAGE,
        list(oracle.parameters()),
        batches=lambda rng: (
            _augmented(trials, part, rng) for part in np.array_split(rng.permutation(chosen), -(-len(chosen) // 64))
        ),
        batches_per_epoch=-(-len(chosen) // 64),
        loss=loss,
        validate=validate,
    )
    folder.mkdir(parents=True, exist_ok=True)
    fit(oracle, stage, folder, seed)
    return _scored(oracle.eval(), trials)


def loss_of(said: tuple[Tensor, Tensor, Tensor], error: Tensor) -> Tensor:
    """Cross-entropy of the direction and half the normal likelihood of the error."""
    logits, estimate, log_sigma = said
    z = (estimate - error) * torch.exp(-log_sigma)
    label = torch.from_numpy(class_of(error.numpy()))
    total: Tensor = functional.cross_entropy(logits, label) + 0.5 * (0.5 * z.square() + log_sigma).mean()
    return total


def _scored(oracle: MotionOracle, trials: Trials) -> dict[str, dict[str, float]]:
    chosen = {split: rows for split in SPLITS[1:] if len(rows := trials.of(split))}
    samples = {split: _predictions(oracle, trials, rows) for split, rows in chosen.items()}
    groups = {split: trials.groups[rows] for split, rows in chosen.items()}
    return by_split({split: (samples[split], groups[split]) for split in chosen}, samples["validation"].calibration())


def _predictions(oracle: MotionOracle, trials: Trials, chosen: NDArray[np.int64]) -> Predictions:
    motion, geometry, error = _whole(trials, chosen)
    with torch.inference_mode():
        logits, estimate, log_sigma = (value.double().numpy() for value in oracle(motion, geometry_features(geometry)))
    return Predictions(logits, estimate, log_sigma, error.double().numpy(), trials.objects[chosen])


def _cut(trials: Trials, chosen: NDArray[np.int64], offset: NDArray[np.int64]) -> Floats:
    """Motion [N, 8, 6] since the first of the decision's frames."""
    steps = offset[:, None] + np.arange(FRAMES_PER_DECISION)
    motion = trials.motion[chosen][np.arange(len(chosen))[:, None], steps]
    return np.asarray(motion - motion[:, :1], np.float32)


def _whole(trials: Trials, chosen: NDArray[np.int64]) -> tuple[Tensor, Tensor, Tensor]:
    motion = _cut(trials, chosen, np.full(len(chosen), JITTER))
    return torch.from_numpy(motion), torch.from_numpy(trials.geometry[chosen]), torch.from_numpy(trials.error[chosen])


def _augmented(trials: Trials, chosen: NDArray[np.int64], rng: np.random.Generator) -> tuple[Tensor, Tensor, Tensor]:
    motion = _cut(trials, chosen, rng.integers(0, 2 * JITTER + 1, len(chosen)))
    error = trials.error[chosen].copy()
    mirrored, turned = rng.random((2, len(chosen))) < 0.5
    motion[mirrored] *= MIRRORED
    motion[turned] *= HALF_TURNED
    error[mirrored] *= MIRROR_SIGNS
    error[turned] *= HALF_TURN_SIGNS
    geometry = blurred_geometry(trials.geometry[chosen], rng)
    return torch.from_numpy(motion), torch.from_numpy(geometry), torch.from_numpy(error)
