"""One training in several processes: ``torchrun --standalone --nproc-per-node 2 -m training train CONFIG``.

Every process holds the whole network and an equal share of the training trials; gradients are averaged before each
step, so all take the same one. The first process writes; alone, a process notices nothing of this.
"""

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
import torch.distributed as dist
from numpy.typing import NDArray
from torch import nn


@contextmanager
def group() -> Iterator[None]:
    """Join the processes that torchrun started, over gloo; nothing to join without it."""
    if int(os.environ.get("WORLD_SIZE", "1")) < 2:
        yield
        return
    dist.init_process_group("gloo")
    try:
        yield
    finally:
        dist.destroy_process_group()


def together() -> bool:
    """Whether other processes take part."""
    return dist.is_available() and dist.is_initialized()


def rank() -> int:
    """Number of this process, 0 for the first and for a lonely one."""
    return dist.get_rank() if together() else 0


def first() -> bool:
    """Whether this process writes files and progress."""
    return rank() == 0


def share(chosen: NDArray[np.int64]) -> NDArray[np.int64]:
    """This process's share of some trials: all shares are equally long, so that all make as many steps."""
    if not together():
        return chosen
    count = dist.get_world_size()
    return chosen[: len(chosen) // count * count][rank() :: count]


def seeds(*seed: int) -> list[int]:
    """Seeds of this process: its own where there are others, so that shares are not augmented alike."""
    return [*seed, rank()] if together() else list(seed)


def average_gradients(parameters: Iterable[nn.Parameter]) -> None:
    """Replace every gradient by its mean over the processes, in one exchange."""
    if not together():
        return
    gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
    flat = torch.cat([gradient.flatten() for gradient in gradients])
    dist.all_reduce(flat)
    flat /= dist.get_world_size()
    means = torch.split(flat, [gradient.numel() for gradient in gradients])
    for gradient, mean in zip(gradients, means, strict=True):
        gradient.copy_(mean.view_as(gradient))


def agreed(value: Any) -> Any:
    """The first process's value, on all of them: clocks differ, and all must stop after the same epoch."""
    if not together():
        return value
    box = [value]
    dist.broadcast_object_list(box)
    return box[0]


@contextmanager
def first_goes_first() -> Iterator[None]:
    """A block that the first process runs before the others: it fills the caches that they read."""
    if together() and not first():
        dist.barrier()
    yield
    if together() and first():
        dist.barrier()
