"""Measuring a model on this machine: wall and CPU time of each call, and how noisy the machine was meanwhile."""

import resource
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from export.golden import golden_frames
from export.verify import Arrays, Model, told

WARM_UP_CALLS = 10
NOISY = 1.5
"""A machine whose wall time exceeds its CPU time by this factor at the median was busy with something else."""


@dataclass(frozen=True)
class Timing:
    """Times of repeated calls in ms; ``crowding`` is the median wall time over the median CPU time."""

    calls: int
    p50_ms: float
    p90_ms: float
    p99_ms: float
    p999_ms: float
    cpu_p50_ms: float
    cpu_p99_ms: float
    crowding: float

    @classmethod
    def of(cls, wall_ms: NDArray[np.float64], cpu_ms: NDArray[np.float64]) -> "Timing":
        """Percentiles of the calls."""
        p50, p90, p99, p999 = (float(np.percentile(wall_ms, q)) for q in (50, 90, 99, 99.9))
        cpu50, cpu99 = (float(np.percentile(cpu_ms, q)) for q in (50, 99))
        return cls(len(wall_ms), p50, p90, p99, p999, cpu50, cpu99, p50 / max(cpu50, 1e-6))

    @property
    def noisy(self) -> bool:
        """Whether the wall times describe the neighbours more than the model."""
        return self.crowding > NOISY

    def as_dict(self) -> dict[str, float]:
        """Plain numbers."""
        return asdict(self)


def example_inputs(model: Model, batch: int = 1) -> Arrays:
    """Golden inputs of a model, as the service would feed them."""
    card = model.card
    frames = np.repeat(golden_frames(card.frame, card.frames_per_decision)[None], batch, 0)
    if card.form == "sequence":
        return {"frames": frames} | told(card, batch)
    state = np.zeros((batch, card.state_size), np.float32)
    step: Arrays = {"frame": frames[:, -1], "reference": frames[:, 0], "state": state}
    return step | told(card, batch)


def time_calls(call: Callable[[], Any], *, seconds: float = 2.0, least: int = 30) -> Timing:
    """Call repeatedly for ``seconds``, at least ``least`` times, after a warm-up that is not counted."""
    for _ in range(WARM_UP_CALLS):
        call()
    wall: list[float] = []
    cpu: list[float] = []
    end = time.perf_counter() + seconds
    while len(wall) < least or time.perf_counter() < end:
        wall_before, cpu_before = time.perf_counter_ns(), time.thread_time_ns()
        call()
        cpu.append((time.thread_time_ns() - cpu_before) / 1e6)
        wall.append((time.perf_counter_ns() - wall_before) / 1e6)
    return Timing.of(np.array(wall), np.array(cpu))


def paired_ratio(one: Callable[[], Any], other: Callable[[], Any], rounds: int = 40) -> tuple[float, float, float]:
    """Median and quartiles of one's CPU time over the other's, measured in turn so that noise hits both alike."""
    for _ in range(WARM_UP_CALLS):
        one(), other()
    ratios = [_cpu_ms(one) / max(_cpu_ms(other), 1e-6) for _ in range(rounds)]
    low, middle, high = (float(np.percentile(ratios, q)) for q in (25, 50, 75))
    return middle, low, high


def _cpu_ms(call: Callable[[], Any]) -> float:
    before = time.thread_time_ns()
    call()
    return (time.thread_time_ns() - before) / 1e6


def peak_memory_mb() -> float:
    """Largest resident size of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
