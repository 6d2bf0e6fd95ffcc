"""Training data of the recipe: the chosen trials, and their frozen features cached on disk."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import track
from torch import Tensor

from service.contract import ContractError, Sensor
from training.config import JITTER, RecipeConfig
from training.data.dataset import SPLITS, Source
from training.data.labels import CLASSES, class_of
from training.networks.alexnet import FEATURES, AlexNetLstm, difference_images
from training.networks.settings import FRAMES_PER_DECISION

RARE = ("7", "8")
CROP_PX = 12


@dataclass(frozen=True, slots=True)
class Rows:
    """Trials of the recipe with their cached features, float16 [N, 8, 2, 9216]; ``crop`` rows are duplicates."""

    trial: NDArray[np.int64]
    crop: NDArray[np.bool_]
    split: NDArray[np.int64]
    error: NDArray[np.float32]
    objects: NDArray[np.str_]
    groups: NDArray[np.str_]
    convolved: NDArray[np.float16]
    sensor: Sensor

    def of(self, split: str) -> NDArray[np.int64]:
        """Rows of one split; duplicates exist in training only."""
        return np.flatnonzero(self.split == SPLITS.index(split))


def chosen_trials(table: dict[str, NDArray[Any]], split: str, count: int) -> NDArray[np.int64]:
    order = np.argsort(table["key"])
    chosen: NDArray[np.int64] = order[table["split"][order] == SPLITS.index(split)][:count]
    return chosen


def decision_frames(source: Source, table: dict[str, NDArray[Any]], trial: int) -> Tensor:
    """The decision's frames of one trial, uint8 [8, 2, H, W, 3]."""
    start = int(table["start"][trial]) + JITTER
    return torch.from_numpy(source.frames(int(table["index"][trial]), start, FRAMES_PER_DECISION))


def load_rows(config: RecipeConfig, source: Source, table: dict[str, NDArray[Any]], network: AlexNetLstm) -> Rows:
    """Choose trials, double the rare classes, and compute or read the frozen features."""
    counts = {"train": config.training_trials, "validation": config.validation_trials, "test": config.test_trials}
    trials = np.concatenate([chosen_trials(table, split, count) for split, count in counts.items()])
    names = np.array([entry.name for entry in CLASSES])[class_of(table["error"][trials])]
    rare = trials[np.isin(names, RARE) & (table["split"][trials] == SPLITS.index("train"))]
    every = np.concatenate([trials, rare])
    crop = np.arange(len(every)) >= len(trials)
    return Rows(
        every,
        crop,
        table["split"][every],
        table["error"][every],
        table["objects"][every],
        table["groups"][every],
        _convolved(config, source, table, network, every, crop),
        source.manifest.sensor,
    )


def _convolved(
    config: RecipeConfig,
    source: Source,
    table: dict[str, NDArray[Any]],
    network: AlexNetLstm,
    trials: NDArray[np.int64],
    crop: NDArray[np.bool_],
) -> NDArray[np.float16]:
    """Features [N, 8, 2, 9216], cached in the run's folder with the number of rows done; a kill costs one row."""
    path, counter = config.folder / "features.npy", config.folder / "features.done"
    shape = (len(trials), FRAMES_PER_DECISION, 2, FEATURES)
    done = _rows_done(counter) if path.exists() else 0
    kept = np.lib.format.open_memmap(path, "r+" if path.exists() else "w+", np.float16, shape)
    if kept.shape != shape:
        raise ContractError(f"{path} holds features of {kept.shape[0]} trials, expected {shape[0]}; remove it")
    rng = np.random.default_rng(config.seed)
    shifts = rng.integers(-CROP_PX, CROP_PX + 1, (len(trials), 2)) * crop[:, None]
    network.eval()
    with torch.inference_mode():
        for row in track(range(done, len(trials)), description="convolution features"):
            frames = decision_frames(source, table, int(trials[row]))
            reference = frames[:1].expand_as(frames)
            shift_px = (int(shifts[row, 0]), int(shifts[row, 1]))
            images = difference_images(frames.flatten(0, 1), reference.flatten(0, 1), shift_px).to(network.device)
            kept[row] = network.convolved(images).reshape(shape[1:]).half().cpu().numpy()
            counter.write_text(str(row + 1))
    kept.flush()
    return kept


def _rows_done(counter: Path) -> int:
    """Number of computed rows; 0 where a kill truncated it."""
    text = counter.read_text() if counter.exists() else ""
    return int(text) if text.isdigit() else 0
