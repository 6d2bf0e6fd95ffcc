"""Recorded collisions, and the command that two networks give for them by the paper's rule."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from export.onnx.model import Arrays, Model, geometry_inputs
from export.onnx.model import steps as stepped
from service.contract import ContractError, ModelCard, Sensor
from service.perception.markers.sequence import track_pairs
from training.data.dataset import open_source
from training.networks.settings import FRAMES_PER_DECISION

GAIN = 0.7
"""Where class and estimate agree, the command is minus this factor times the estimate."""


@dataclass(frozen=True)
class Decision:
    """A recorded collision: ``frames`` uint8 [T, 2, H, W, 3] from the onset, the gap and the grasp height."""

    frames: NDArray[np.uint8]
    gap_width_mm: float
    grasp_height_mm: float
    sensor: Sensor = field(default_factory=Sensor.load)

    @cached_property
    def markers(self) -> NDArray[np.float32]:
        """Markers tracked in the frames: float32 [T, 2, rows, columns, 3]."""
        return track_pairs(self.frames, self.sensor.markers, self.sensor.fps)

    def input_of(self, card: ModelCard) -> NDArray[Any]:
        """The decision as the input of a card's graph."""
        return self.markers if card.markers else self.frames


def command(card: ModelCard, outputs: Arrays) -> NDArray[np.float64]:
    """Eq. 1 of the paper, (mm, deg) [2]: -0.7 d, -0.3 d without a class, -3 S where class and estimate contradict."""
    error = outputs["error"][0]
    entry = card.classes[int(outputs["logits"][0].argmax())]
    signs = np.array([entry.sign_x, entry.sign_theta])
    stepped = np.where(signs * error > 0, -GAIN * error, -3.0 * signs)
    return np.asarray(np.where(signs == 0, -0.3 * error, stepped), np.float64)


def read_validation(path: str, count: int) -> Iterator[Decision]:
    """``count`` collisions spread over the validation split of a dataset; ContractError if it has none."""
    if count < 1:
        raise ContractError(f"--decisions {count}: expected at least 1")
    source = open_source(path)
    kinds = [(trial.split, trial.outcome) for trial in map(source.trial, range(len(source)))]
    inside = [index for index, kind in enumerate(kinds) if kind == ("validation", "blocked")]
    if not inside:
        raise ContractError(f"the dataset {path} has no collision in its validation split")
    for place in np.linspace(0, len(inside) - 1, min(count, len(inside))).astype(int):
        trial = source.trial(inside[place])
        frames = source.frames(inside[place], int(trial.onset_frame), FRAMES_PER_DECISION)
        geometry_mm = float(trial.gap_width_mm), float(trial.grasp_height_mm)
        yield Decision(frames, *geometry_mm, source.manifest.sensor)


def steps(model: Model, decisions: Sequence[Decision]) -> Iterator[Arrays]:
    """Outputs of a step model after each frame of several decisions in one batch, one row per decision."""
    rows = [geometry_inputs(model.card, 1, row.gap_width_mm, row.grasp_height_mm) for row in decisions]
    geometry = {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}
    frames = np.stack([decision.input_of(model.card) for decision in decisions])
    yield from stepped(model, frames, frames.shape[1], geometry)
