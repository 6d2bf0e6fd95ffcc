"""One training in several processes: ``torchrun --standalone --nproc-per-node 2 -m training train CONFIG``.

Every process holds the whole network and an equal share of the training trials; DistributedDataParallel averages the
gradients before each step, so that all take the same step. The first process writes. A single process needs none of
this.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch.distributed as dist
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel


@contextmanager
def group() -> Iterator[None]:
    """Join the processes that torchrun started, over gloo; does nothing without torchrun."""
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
    """Number of this process, 0 for the first or only one."""
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
    """Seeds of this process: different in each process, so that shares are augmented differently."""
    return [*seed, rank()] if together() else list(seed)


def averaged(network: nn.Module, loss: Callable[[Any], Tensor]) -> Callable[[Any], Tensor]:
    """``loss`` of a batch; with other processes, its gradients are the mean over all of them."""
    if not together():
        return loss
    return DistributedDataParallel(_Loss(network, loss), find_unused_parameters=True, broadcast_buffers=False)


class _Loss(nn.Module):
    """A stage's loss as one forward pass, the form that DistributedDataParallel wraps."""

    def __init__(self, network: nn.Module, loss: Callable[[Any], Tensor]) -> None:
        super().__init__()
        self.network, self.loss = network, loss

    def forward(self, batch: Any) -> Tensor:
        return self.loss(batch)


def agreed(value: Any) -> Any:
    """The first process's value, on all of them: clocks differ, but all must stop after the same epoch."""
    if not together():
        return value
    box = [value]
    dist.broadcast_object_list(box)
    return box[0]


@contextmanager
def first_goes_first() -> Iterator[None]:
    """A block that the first process runs before the others, to fill the caches that they read."""
    if together() and not first():
        dist.barrier()
    yield
    if together() and first():
        dist.barrier()
