"""The information limit of pressing: a decision from the object's true motion in the hand at each step of depth.

A perfect reader of the gel knows how the object moved in the fingers and nothing else. A recurrent network of the same
size reads that motion (6 degrees of freedom, exact) and all conditions exactly. Its performance is the limit of any
tactile network.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import track
from torch import Tensor, nn
from torch.nn import functional

from training.config import StageConfig
from training.data.dataset import SPLITS, Source
from training.data.labels import CLASSES, HALF_TURN_SIGNS, MIRROR_SIGNS, class_of
from training.fit.loop import Stage, fit
from training.metrics.figures import Predictions, by_split
from training.networks.decider import ERROR_SCALE
from training.networks.pressing import DECISION_STEPS, STEP_MM, USUAL

STAGE = StageConfig(epochs=40, batch=64, learning_rate=3e-3, patience=40)
# Hand frame: place x, y, z in mm, turn about x, y, z in rad
MIRRORED = np.array([-1, 1, 1, 1, -1, -1], np.float32)
HALF_TURNED = np.array([-1, -1, 1, -1, -1, 1], np.float32)
Floats = NDArray[np.float32]
Rows = dict[str, dict[str, float]]


class Motions(NamedTuple):
    """Of each press: motion [N, steps, 6] in mm and rad, conditions [N, 5] as logarithms, error (mm, deg), split."""

    motion: Floats
    conditions: Floats
    error: Floats
    split: NDArray[np.int64]
    groups: NDArray[np.str_]

    def of(self, split: str) -> NDArray[np.int64]:
        return np.flatnonzero(self.split == SPLITS.index(split))

    def tensors(self, chosen: NDArray[np.int64], rng: np.random.Generator | None = None) -> tuple[Tensor, ...]:
        """Motion, conditions and error; with ``rng``, through the symmetries of the hand."""
        motion, error = self.motion[chosen].copy(), self.error[chosen].copy()
        if rng is not None:
            mirrored, turned = rng.random((2, len(chosen))) < 0.5
            motion[mirrored] *= MIRRORED
            motion[turned] *= HALF_TURNED
            error[mirrored] *= MIRROR_SIGNS
            error[turned] *= HALF_TURN_SIGNS
        return torch.from_numpy(motion), torch.from_numpy(self.conditions[chosen]), torch.from_numpy(error)


def read_motions(source: Source) -> Motions:
    """The true motion of every press that collided, at the steps of depth that a decision takes."""
    kept = [_motion(source.trial(index)) for index in track(range(len(source)), "reading motions", transient=True)]
    rows = [row for row in kept if row is not None]
    motion, conditions, error, split, groups = zip(*rows, strict=True)
    single = [np.array(values, np.float32) for values in (motion, conditions, error)]
    return Motions(single[0], single[1], single[2], np.array(split), np.array(groups))


def _motion(trial: Any) -> tuple[Any, ...] | None:
    if trial.outcome != "blocked" or trial.onset_frame < 1:
        return None
    begin, end = int(trial.onset_frame) - 1, int(trial.stop_frame) + 1
    depths_mm = np.asarray(trial.depth_mm[begin:end], np.float64)
    hand = np.asarray(trial.in_hand[begin:end], np.float64)
    at_mm = depths_mm[0] + STEP_MM * np.arange(1, DECISION_STEPS + 1)
    moved = np.stack([np.interp(at_mm, depths_mm, axis) - axis[0] for axis in hand.T], 1)
    known = (trial.gap_width_mm, trial.grasp_height_mm, trial.grip_n, trial.shear_reach_mm, trial.speed_mm_s)
    conditions = np.log(np.maximum(known, 1e-3) / np.array(USUAL[: len(known)]))
    return moved, conditions, (trial.x_mm, trial.theta_deg), SPLITS.index(trial.split), str(trial.group)


class MotionOracle(nn.Module):
    """True in-hand motion [B, T, 6] since the first frame, and other known inputs [B, told] -> decision state."""

    spread: Tensor

    def __init__(self, spread: Tensor, conditions_n: int, width: int = 128) -> None:
        super().__init__()
        self.read = nn.Sequential(nn.Linear(6, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU())
        self.cell = nn.GRUCell(width + conditions_n, width)
        self.direction = nn.Linear(width, len(CLASSES))
        self.magnitude = nn.Linear(width, 4)
        self.register_buffer("spread", spread)

    def forward(self, motion: Tensor, conditions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Class logits, error in (mm, deg) and its log sigma."""
        features = self.read(motion / self.spread)
        state = torch.zeros(len(motion), self.cell.hidden_size)
        for step in range(motion.shape[1]):
            state = self.cell(torch.cat([features[:, step], conditions], 1), state)
        out = self.magnitude(state)
        return self.direction(state), out[:, :2] * ERROR_SCALE, out[:, 2:].clamp(-4.0, 4.0)


def loss_of(outputs: tuple[Tensor, Tensor, Tensor], error: Tensor) -> Tensor:
    """Cross-entropy of the direction and half the normal likelihood of the error."""
    logits, estimate, log_sigma = outputs
    z = (estimate - error) * torch.exp(-log_sigma)
    label = torch.from_numpy(class_of(error.numpy()))
    total: Tensor = functional.cross_entropy(logits, label) + 0.5 * (0.5 * z.square() + log_sigma).mean()
    return total


def oracle_rows(source: Source, folder: Path, seed: int = 0) -> Rows:
    """Figures of the oracle on "validation/all" and "test/all"; trained once, kept in ``folder``."""
    torch.manual_seed(seed)
    motions = read_motions(source)
    chosen, held = motions.of("train"), motions.of("validation")
    spread = torch.from_numpy(motions.motion[chosen].std((0, 1)) + 1e-6)
    oracle = MotionOracle(spread, conditions_n=motions.conditions.shape[1])

    def loss(batch: tuple[Tensor, ...]) -> Tensor:
        return loss_of(oracle(batch[0], batch[1]), batch[2])

    def validate() -> dict[str, float]:
        with torch.inference_mode():
            return {"score": float(loss(motions.tensors(held)))}

    count = -(-len(chosen) // STAGE.batch)
    stage = Stage(
        "oracle",
        STAGE,
        list(oracle.parameters()),
        batches=lambda rng: (motions.tensors(part, rng) for part in np.array_split(rng.permutation(chosen), count)),
        batches_per_epoch=count,
        loss=loss,
        validate=validate,
    )
    folder.mkdir(parents=True, exist_ok=True)
    fit(oracle, stage, folder, seed)
    return _scored(oracle.eval(), motions)


def _scored(oracle: MotionOracle, motions: Motions) -> Rows:
    samples = {}
    for split in SPLITS[1:]:
        if len(chosen := motions.of(split)):
            motion, conditions, error = motions.tensors(chosen)
            with torch.inference_mode():
                logits, estimate, log_sigma = (value.double().numpy() for value in oracle(motion, conditions))
            names = np.full(len(chosen), "cells")
            predictions = Predictions(logits, estimate, log_sigma, error.double().numpy(), names)
            samples[split] = predictions, motions.groups[chosen]
    return by_split(samples, samples["validation"][0].calibration())
