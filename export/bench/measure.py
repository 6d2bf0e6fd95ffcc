"""Measuring a model on this machine: wall and CPU time of each call, and how noisy the machine was meanwhile."""

import gc
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from export.onnx.golden import golden_input
from export.onnx.model import Arrays, Model, geometry_inputs

Clock = Callable[[], int]
WARM_UP_CALLS = 10
TAIL_BLOCK = 64
NOISY = 1.5
"""A machine whose wall time exceeds its CPU time by this factor at the median was busy with something else."""
NOISY_SPREAD = 0.25
"""Spread of a model's wall time against itself, call by call: beyond it, wall times cannot be compared."""
STEADY = 1.5
"""p99 over p50 of the processor time on one thread that a deciding network may have."""


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
    def budget_p99_ms(self) -> float:
        """The p99 to hold against a budget: of the wall time, or of the processor's where neighbours stretched it."""
        stretched = self.noisy or self.p99_ms > NOISY * self.cpu_p99_ms
        return self.cpu_p99_ms if stretched else self.p99_ms

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
    frames = np.repeat(golden_input(card)[None], batch, 0)
    if card.form == "sequence":
        return {"frames": frames} | geometry_inputs(card, batch)
    state = np.zeros((batch, card.state_size), np.float32)
    step: Arrays = {"frame": frames[:, -1], "reference": frames[:, 0], "state": state}
    return step | geometry_inputs(card, batch)


def time_calls(
    call: Callable[[], Any], *, seconds: float = 2.0, least: int = 30, clock: Clock = time.process_time_ns
) -> Timing:
    """Call repeatedly for ``seconds``, at least ``least`` times, after a warm-up that is not counted."""
    return time_in_turn({"": call}, seconds=seconds, least=least, clock=clock)[""][0]


@contextmanager
def undisturbed() -> Iterator[None]:
    """Keep this thread on the core it runs on and the collector of garbage away, as a cell's service is set up."""
    cores, collecting = os.sched_getaffinity(0), gc.isenabled()
    os.sched_setaffinity(0, {max(cores)})
    gc.disable()
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)
        if collecting:
            gc.enable()


def tails(call: Callable[[], Any], *, seconds: float) -> dict[str, float]:
    """p99 over p50 of the processor time of a call on one core, and of arithmetic of the same length beside it.

    The two are called in turn; every call counts. ``machine_tail``, of arithmetic that never changes, is what the
    hypervisor and the neighbours do to anything that runs here.
    """
    with undisturbed():
        length_ms = time_calls(call, seconds=seconds / 10, clock=time.thread_time_ns).cpu_p50_ms
        calls = {"tail": call, "machine_tail": _constant_work(length_ms)}
        rows = time_in_turn(calls, seconds=2 * seconds, warm=True, clock=time.thread_time_ns)
    return {name: timing.cpu_p99_ms / max(timing.cpu_p50_ms, 1e-6) for name, (timing, _) in rows.items()}


def _constant_work(length_ms: float) -> Callable[[], None]:
    block = np.full((TAIL_BLOCK, TAIL_BLOCK), 0.5, np.float32)
    once = time_calls(lambda: block @ block, seconds=0.02, clock=time.thread_time_ns).cpu_p50_ms
    repeats = max(1, round(length_ms / max(once, 1e-6)))

    def work() -> None:
        for _ in range(repeats):
            block @ block

    return work


def time_in_turn(
    calls: Mapping[str, Callable[[], Any]],
    *,
    seconds: float = 2.0,
    least: int = 30,
    warm: bool = False,
    clock: Clock = time.process_time_ns,
) -> dict[str, tuple[Timing, NDArray[np.float64]]]:
    """Time several calls, one of each in turn, so that noise hits all alike; timing and (wall, CPU) ms [2, N] of each.

    ``warm`` calls each once untimed before its timed call, where others in turn would empty its caches. The processor
    time is that of all threads of this process, so that nothing else may run in it meanwhile, or with
    ``clock=time.thread_time_ns`` of the calling thread alone, which is all there is where a session has one.
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
            wall_before, cpu_before = time.perf_counter_ns(), clock()
            call()
            cpu_ms = (clock() - cpu_before) / 1e6
            spent[name].append(((time.perf_counter_ns() - wall_before) / 1e6, cpu_ms))
    rows = {name: np.array(pairs).T for name, pairs in spent.items()}
    return {name: (Timing.of(row[0], row[1]), row) for name, row in rows.items()}


def quartiles(one: NDArray[np.float64], other: NDArray[np.float64]) -> tuple[float, float, float]:
    """Median and quartiles of the ratios of two rows of times measured in turn."""
    count = min(len(one), len(other))
    ratios = one[:count] / np.maximum(other[:count], 1e-6)
    low, middle, high = (float(np.percentile(ratios, q)) for q in (25, 50, 75))
    return middle, low, high


def noise(call: Callable[[], Any], *, seconds: float) -> dict[str, float]:
    """How far a model measured in turn seems to differ from itself: (q75 - q25) / median of the ratio."""
    rows = time_in_turn({"one": call, "other": call}, seconds=seconds)
    wall, cpu = (quartiles(rows["one"][1][kind], rows["other"][1][kind]) for kind in (0, 1))
    return {"wall_spread": (wall[2] - wall[1]) / wall[0], "cpu_spread": (cpu[2] - cpu[1]) / cpu[0]}
