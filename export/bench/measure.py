"""Measuring calls on this machine: wall and processor time of each."""

import gc
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from export.onnx.golden import golden_input
from export.onnx.model import Arrays, Model, geometry_inputs

WARM_UP_CALLS = 10


class Timing(NamedTuple):
    """Times of repeated calls in ms: medians and 99th percentiles."""

    calls: int
    p50_ms: float
    p99_ms: float
    cpu_p50_ms: float
    cpu_p99_ms: float

    @classmethod
    def of(cls, wall_ms: NDArray[np.float64], cpu_ms: NDArray[np.float64]) -> "Timing":
        return cls(len(wall_ms), *(float(np.percentile(times, q)) for times in (wall_ms, cpu_ms) for q in (50, 99)))


def _example_inputs(model: Model) -> Arrays:
    """Golden inputs of a model, as the service would feed them."""
    card = model.card
    frames = golden_input(card)[None]
    if card.form == "sequence":
        return {"frames": frames} | geometry_inputs(card, 1)
    state = np.zeros((1, card.state_size), np.float32)
    step: Arrays = {"frame": frames[:, -1], "reference": frames[:, 0], "state": state}
    return step | geometry_inputs(card, 1)


def together(models: Sequence[Model]) -> Callable[[], Any]:
    """A call of all models, one after the other, on golden inputs."""
    inputs = [_example_inputs(model) for model in models]
    return lambda: [model(given) for model, given in zip(models, inputs, strict=True)]


@contextmanager
def undisturbed() -> Iterator[None]:
    """Pin this thread to its core and disable garbage collection, as in a cell's service."""
    cores, collecting = os.sched_getaffinity(0), gc.isenabled()
    os.sched_setaffinity(0, {max(cores)})
    gc.disable()
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)
        if collecting:
            gc.enable()


def time_in_turn(
    calls: Mapping[str, Callable[[], Any]], *, seconds: float, least: int = 30, warm: bool = False
) -> dict[str, tuple[Timing, NDArray[np.float64]]]:
    """Time several calls, one of each in turn, so that noise hits all alike; timing and (wall, CPU) ms [2, N] of each.

    ``warm`` calls each once untimed before its timed call, since the others empty its caches. The processor time is
    that of the calling thread, which is all of it for sessions with one thread.
    """
    for call in calls.values():
        for _ in range(WARM_UP_CALLS):
            call()
    spent: dict[str, list[tuple[float, float]]] = {name: [] for name in calls}
    end = time.perf_counter() + seconds
    while min(map(len, spent.values())) < least or time.perf_counter() < end:
        for name, call in calls.items():
            if warm:
                call()
            wall_before, cpu_before = time.perf_counter_ns(), time.thread_time_ns()
            call()
            cpu_ms = (time.thread_time_ns() - cpu_before) / 1e6
            spent[name].append(((time.perf_counter_ns() - wall_before) / 1e6, cpu_ms))
    rows = {name: np.array(pairs).T for name, pairs in spent.items()}
    return {name: (Timing.of(row[0], row[1]), row) for name, row in rows.items()}


def quartiles(one: NDArray[np.float64], other: NDArray[np.float64]) -> tuple[float, float, float]:
    """Median and quartiles of the ratios of two rows of times measured in turn."""
    count = min(len(one), len(other))
    ratios = one[:count] / np.maximum(other[:count], 1e-6)
    low, middle, high = (float(np.percentile(ratios, q)) for q in (25, 50, 75))
    return middle, low, high
