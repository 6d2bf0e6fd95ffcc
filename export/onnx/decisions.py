"""Recorded collisions, and what a network decides on them: class, estimate and the command of the paper's rule."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from export.onnx.model import Arrays, Model, geometry_inputs
from service.contract import ContractError, ModelCard, Sensor
from service.perception.markers.sequence import track_pairs
from training.data.dataset import SPLITS, open_source
from training.data.labels import class_of

FRAMES = 8
GAIN = 0.7
"""A command is -0.7 of the estimate where class and estimate agree."""


@dataclass(frozen=True)
class Decision:
    """A recorded collision: ``frames`` uint8 [T, 2, H, W, 3] from the onset, the gap and the true error (mm, deg)."""

    frames: NDArray[np.uint8]
    gap_width_mm: float
    grasp_height_mm: float
    truth: NDArray[np.float32]
    name: str
    sensor: Sensor = field(default_factory=Sensor.load)

    @cached_property
    def markers(self) -> NDArray[np.float32]:
        """Markers tracked in the frames: float32 [T, 2, rows, columns, 3]."""
        return track_pairs(self.frames, self.sensor.markers, self.sensor.fps)

    def input_of(self, card: ModelCard) -> NDArray[Any]:
        """The decision as a card's graph reads it."""
        return self.markers if card.markers else self.frames


@dataclass(frozen=True)
class Answer:
    """A network's decision: class index, error [2] and the command [2] that follows, in (mm, deg)."""

    chosen: int
    error: NDArray[np.float64]
    command: NDArray[np.float64]


def density_mean(card: ModelCard, log_density: NDArray[Any]) -> NDArray[np.float64]:
    """Mean error [N, 2] in (mm, deg) of a joint density."""
    weight = np.exp(log_density.astype(np.float64) - log_density.max((1, 2), keepdims=True))
    weight /= weight.sum((1, 2), keepdims=True)
    return np.stack([weight.sum(2) @ np.array(card.grid_x_mm), weight.sum(1) @ np.array(card.grid_theta_deg)], 1)


def paper_rule(card: ModelCard, logits: NDArray[Any], error: NDArray[Any]) -> NDArray[np.float64]:
    """Eq. 1 of the paper: -0.7 d, -0.3 d without a class, -3 S where class and estimate contradict."""
    signs = np.array([(entry.sign_x, entry.sign_theta) for entry in card.classes])[logits.argmax(1)]
    agreeing = signs * error > 0
    stepped = np.where(agreeing, -GAIN * error, -3.0 * signs)
    return np.asarray(np.where(signs == 0, -0.3 * error, stepped), np.float64)


def most_likely_class(card: ModelCard, outputs: Arrays) -> int:
    """Index of the class that a network's outputs hold for most likely; of an estimate alone, the class it lies in."""
    if "logits" in outputs:
        return int(outputs["logits"][0].argmax())
    if "error" in outputs:
        return int(class_of(outputs["error"])[0])
    density = outputs["log_density"][0].astype(np.float64)
    weight = np.exp(density - density.max())
    x_mm, theta_deg = np.meshgrid(card.grid_x_mm, card.grid_theta_deg, indexing="ij")
    cells = class_of(np.stack([x_mm, theta_deg], -1).reshape(-1, 2).astype(np.float32))
    return int(np.bincount(cells, weight.ravel(), len(card.classes)).argmax())


def answer(card: ModelCard, outputs: Arrays) -> Answer:
    """Class, estimate and command of all outputs of a candidate; a joint density's command needs no class."""
    error = estimate(card, outputs)
    command = paper_rule(card, outputs["logits"], outputs["error"])[0] if "logits" in outputs else -GAIN * error
    return Answer(most_likely_class(card, outputs), error, command)


def estimate(card: ModelCard, outputs: Arrays) -> NDArray[np.float64]:
    """Estimated error [2] in (mm, deg); a joint density's is its mean."""
    if "error" in outputs:
        return np.asarray(outputs["error"][0], np.float64)
    mean: NDArray[np.float64] = density_mean(card, outputs["log_density"])[0]
    return mean


def read_split(path: str, split: str, count: int) -> Iterator[Decision]:
    """``count`` collisions spread over a split of a dataset, drawn one at a time as they are needed.

    Raises ContractError at once on an unknown split or a ``count`` below 1, when drawing if the split has no collision.
    """
    if split not in SPLITS:
        raise ContractError(f"no split {split!r}, expected one of {', '.join(SPLITS)}")
    if count < 1:
        raise ContractError(f"--decisions {count}: expected at least 1")
    return _drawn(path, split, count)


def _drawn(path: str, split: str, count: int) -> Iterator[Decision]:
    source = open_source(path)
    inside = [index for index in range(len(source)) if _collided(source.trial(index), split)]
    if not inside:
        raise ContractError(f"the dataset {path} has no collision in its split {split}")
    for place in np.linspace(0, len(inside) - 1, min(count, len(inside))).astype(int):
        trial = source.trial(inside[place])
        frames = source.frames(inside[place], int(trial.onset_frame), FRAMES)
        truth = np.array([trial.x_mm, trial.theta_deg], np.float32)
        told_mm = float(trial.gap_width_mm), float(trial.grasp_height_mm)
        yield Decision(frames, *told_mm, truth, str(trial.object_name), source.manifest.sensor)


def _collided(trial: object, split: str) -> bool:
    return getattr(trial, "split", "") == split and getattr(trial, "outcome", "") == "blocked"


def steps(model: Model, decisions: Sequence[Decision]) -> Iterator[Arrays]:
    """Outputs of a step model after each frame of several decisions made together, one row a decision."""
    state = np.zeros((len(decisions), model.card.state_size), np.float32)
    geometry = _geometry(model, decisions)
    frames = np.stack([decision.input_of(model.card) for decision in decisions])
    for step in range(frames.shape[1]):
        inputs: Arrays = {"frame": frames[:, step], "reference": frames[:, 0], "state": state}
        outputs = model(inputs | geometry)
        state = outputs["next_state"]
        yield outputs


def _geometry(model: Model, decisions: Sequence[Decision]) -> Arrays:
    rows = [geometry_inputs(model.card, 1, row.gap_width_mm, row.grasp_height_mm) for row in decisions]
    return {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}
