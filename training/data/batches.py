"""Batches for the three stages of training, with onset jitter and the cell's two symmetries."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from training.config import JITTER, WINDOW
from training.data.dataset import Trials
from training.data.labels import HALF_TURN_SIGNS, MIRROR_SIGNS, class_of
from training.networks.settings import FRAMES_PER_DECISION

GAP_BLUR_MM, HEIGHT_BLUR_MM = 0.3, 1.5  # measuring errors of a cell engineer
LAG_FRAMES = 0.25  # lag of a marker behind its time stamp: it is located at the middle of the exposure
HEIGHT_UNKNOWN_SHARE = 0.15  # share of training decisions without a grasp height: cells may not know it


@dataclass(frozen=True, slots=True)
class Batch:
    """A batch of decisions.

    ``fields`` float32 [B, 8, 2, 3, rows, columns], change against the first frame in physical units; ``drawn`` float32
    [B, 8, 2, ...], block sums of pictures or markers tracked in them, or None; ``error`` [B, 2]; ``label`` [B];
    ``geometry`` [B, 2], gap width and grasp height in mm, 0 if unknown. With steps of depth: ``fields`` against rest,
    ``geometry`` [B, 6] all conditions, ``length`` [B] the number of steps.
    """

    fields: Tensor
    drawn: Tensor | None
    error: Tensor
    label: Tensor
    geometry: Tensor
    length: Tensor | None = None

    def to(self, device: torch.device) -> Self:
        """The same batch on a device."""
        values = {name: getattr(self, name) for name in self.__slots__}
        return replace(self, **{name: value.to(device) for name, value in values.items() if value is not None})


def mirror_fields(fields: NDArray[np.float32]) -> NDArray[np.float32]:
    """Mirror in x, for [..., rows, cols, 3]: each finger's picture is flipped along u, and du changes sign."""
    flipped = fields[..., ::-1, :] * np.array([-1, 1, 1], np.float32)
    return np.asarray(flipped, np.float32)


def decisions(trials: Trials, chosen: NDArray[np.int64], rng: np.random.Generator | None, *, pictures: bool) -> Batch:
    """Cut the eight frames out of each window; with ``rng``, jitter the onset, delay the markers, apply symmetries."""
    count = len(chosen)
    offset = rng.integers(0, 2 * JITTER + 1, count) if rng is not None else np.full(count, JITTER)
    steps = offset[:, None] + np.arange(FRAMES_PER_DECISION)
    lines = np.arange(count)[:, None]
    fields = trials.fields[chosen][lines, steps].astype(np.float32)
    if rng is not None and not pictures:
        before = trials.fields[chosen][lines, np.maximum(steps - 1, 0)].astype(np.float32)
        fields -= rng.uniform(0, LAG_FRAMES, (count, 1, 1, 1, 1, 1)).astype(np.float32) * (fields - before)
    fields -= fields[:, :1]
    drawn = None
    if pictures:
        drawn = trials.drawn[trials.picture[chosen]][lines, steps].astype(np.float32)
    error = trials.error[chosen].copy()
    if rng is not None:
        _apply_symmetries(fields, drawn, error, rng)
    return Batch(
        fields=torch.from_numpy(np.moveaxis(fields, -1, -3).copy()),
        drawn=None if drawn is None else torch.from_numpy(drawn),
        error=torch.from_numpy(error),
        label=torch.from_numpy(class_of(error)),
        geometry=torch.from_numpy(blurred_geometry(trials.geometry[chosen], rng)),
    )


def blurred_geometry(geometry: NDArray[np.float32], rng: np.random.Generator | None) -> NDArray[np.float32]:
    """Gap width and grasp height as a cell states them: in training slightly wrong, at times without the height."""
    if rng is None:
        return geometry
    blurred = geometry + rng.normal(0, (GAP_BLUR_MM, HEIGHT_BLUR_MM), geometry.shape)
    known = (geometry[:, 1] > 0) & (rng.random(len(geometry)) >= HEIGHT_UNKNOWN_SHARE)
    blurred[:, 1] = np.where(known, np.maximum(blurred[:, 1], 1.0), 0.0)
    return np.asarray(blurred, np.float32)


def _apply_symmetries(
    fields: NDArray[np.float32],
    pooled: NDArray[np.float32] | None,
    error: NDArray[np.float32],
    rng: np.random.Generator,
) -> None:
    mirrored, turned = rng.random((2, len(error))) < 0.5
    mirrored &= pooled is None  # the lights are red on one side, green on the other: a mirrored picture would be false
    fields[mirrored] = mirror_fields(fields[mirrored])
    fields[turned] = fields[turned][:, :, ::-1]
    if pooled is not None:
        pooled[turned] = pooled[turned][:, :, ::-1]
        pooled *= rng.uniform(0.9, 1.1, (len(error), 1, 1, 1, 1, 1)).astype(np.float32)
    error[mirrored] *= MIRROR_SIGNS
    error[turned] *= HALF_TURN_SIGNS


def frame_pairs(
    trials: Trials, chosen: NDArray[np.int64], size: int, rng: np.random.Generator, pairs: int = 4
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Batches for the front: frame, reference (block sums [n, 2, h, w]) and field change [n, 3, rows, columns].

    Each trial gives ``pairs`` random (frame, reference) pairs of both fingers, the earlier frame being the reference.
    """
    order = rng.permutation(chosen)
    per_batch = max(1, size // (2 * pairs))
    for start in range(0, len(order), per_batch):
        part = order[start : start + per_batch]
        reference = rng.integers(0, 2 * JITTER + 1, (len(part), 1))
        frame = np.minimum(reference + rng.integers(1, FRAMES_PER_DECISION, (len(part), pairs)), WINDOW - 1)
        lines = np.arange(len(part))[:, None]
        pooled = trials.drawn[trials.picture[part]]
        fields = trials.fields[part].astype(np.float32)
        late, early = pooled[lines, frame], np.broadcast_to(pooled[lines, reference], pooled[lines, frame].shape)
        change = fields[lines, frame] - fields[lines, reference]
        yield _pair_tensors(late.astype(np.float32), early.astype(np.float32), change, rng)


def _pair_tensors(
    late: NDArray[np.float32], early: NDArray[np.float32], change: NDArray[np.float32], rng: np.random.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    late, early = late.reshape(-1, *late.shape[-3:]), early.reshape(-1, *early.shape[-3:])
    change = change.reshape(-1, *change.shape[-3:])
    gain = rng.uniform(0.85, 1.15, (len(late), 1, 1, 1)).astype(np.float32)
    return (
        torch.from_numpy(late * gain),
        torch.from_numpy(early * gain),
        torch.from_numpy(np.moveaxis(change, -1, -3).copy()),
    )
