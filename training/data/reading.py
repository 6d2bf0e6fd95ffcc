"""A dataset as the input of a kind of network: frames and tracked markers, or steps of depth."""

from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray

from service.contract import ContractError
from training.config import DataConfig
from training.data import batches
from training.data.batches import Batch
from training.data.dataset import Source, Trials, load_trials, refuse_empty_splits
from training.data.pressed import Pressed, load_pressed
from training.networks import reads

Samples = Trials | Pressed


def load(config: DataConfig, kind: str, source: Source | None = None) -> Samples:
    """Training samples for networks of a kind; ContractError as `load_trials`."""
    shown = reads(kind)
    return load_pressed(config, source) if shown == "steps" else load_trials(config, source, shown)


def refuse_useless(samples: Samples) -> None:
    """Raise ContractError where there is nothing to train on or to validate with.

    Networks that read depth also need errors that differ: their card states the spread.
    """
    refuse_empty_splits(samples.split)
    if isinstance(samples, Pressed):
        for name, span in zip(("x", "yaw"), np.ptp(samples.error[samples.of("train")], axis=0), strict=True):
            if not span:
                raise ContractError(f"all training errors in {name} are the same, expected some that differ")


def decisions(samples: Samples, chosen: NDArray[np.int64], rng: np.random.Generator | None, *, pictures: bool) -> Batch:
    """The chosen decisions, augmented with ``rng``."""
    if isinstance(samples, Pressed):
        return samples.batch(chosen, rng)
    return batches.decisions(samples, chosen, rng, pictures=pictures)


def epoch(
    samples: Samples,
    chosen: NDArray[np.int64],
    size: int,
    rng: np.random.Generator,
    device: torch.device,
    *,
    pictures: bool,
) -> Iterator[Batch]:
    """Shuffled, augmented batches of one epoch, on the device."""
    order = rng.permutation(chosen)
    for start in range(0, len(order), size):
        yield decisions(samples, order[start : start + size], rng, pictures=pictures).to(device)
