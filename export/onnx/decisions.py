"""Recorded collisions, to calibrate builds of a network with and to compare them on."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.contract import ContractError, ModelCard, Sensor
from service.perception.markers.sequence import track_pairs
from training.data.dataset import open_source
from training.networks.settings import FRAMES_PER_DECISION

DECISIONS_N = 64
"""Most collisions of a dataset that are read."""


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


def read_validation(path: str) -> Iterator[Decision]:
    """Collisions spread over the validation split of a dataset; ContractError if it has none."""
    source = open_source(path)
    kinds = [(trial.split, trial.outcome) for trial in map(source.trial, range(len(source)))]
    inside = [index for index, kind in enumerate(kinds) if kind == ("validation", "blocked")]
    if not inside:
        raise ContractError(f"the dataset {path} has no collision in its validation split")
    for place in np.linspace(0, len(inside) - 1, min(DECISIONS_N, len(inside))).astype(int):
        trial = source.trial(inside[place])
        frames = source.frames(inside[place], int(trial.onset_frame), FRAMES_PER_DECISION)
        geometry_mm = float(trial.gap_width_mm), float(trial.grasp_height_mm)
        yield Decision(frames, *geometry_mm, source.manifest.sensor)
