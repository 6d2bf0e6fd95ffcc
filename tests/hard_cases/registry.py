"""A hard case, its registry, and how one is run."""

import functools
import importlib
import inspect
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

Room = Literal["physics", "perception", "networks", "decision", "motion", "data"]
ROOT = Path(__file__).resolve().parents[2]
SEEDS = (0, 1, 2)


@dataclass(frozen=True, slots=True)
class Guard:
    """What answers a case: ``package.module:Qual.name`` of a function, method, class attribute or module constant.

    ``instead`` takes its place in the check, a value or a callable that makes one of the original; ``without`` says
    what is missing then.
    """

    symbol: str
    without: str = ""
    instead: object = None

    def resolve(self) -> tuple[Any, str, Any]:
        """Owner (a module or a class), name in it, and its value; raises ImportError or AttributeError."""
        module, _, qualname = self.symbol.partition(":")
        *path, name = qualname.split(".")
        owner = functools.reduce(getattr, path, importlib.import_module(module))
        return owner, name, inspect.getattr_static(owner, name)


@dataclass(frozen=True, slots=True)
class Case:
    """``measure(seed)`` gives the worst value, or that and a note; the case holds if it is at most ``limit``."""

    name: str
    room: Room
    why: str
    holds: str
    guard: Guard
    limit: float
    measure: Callable[[int], float | tuple[float, str]]
    quick: bool


@dataclass(frozen=True, slots=True)
class Result:
    """Results of a case over its seeds."""

    case: Case
    worst: float
    note: str
    seconds: float
    error: str = ""

    @property
    def passed(self) -> bool:
        """Finite and within the limit, and nothing was raised."""
        return not self.error and math.isfinite(self.worst) and self.worst <= float(self.case.limit)


CASES: dict[str, Case] = {}
Measure = Callable[[int], float | tuple[float, str]]


def case(
    room: Room,
    *,
    why: str,
    holds: str,
    guard: Guard | str,
    limit: float = 0.0,
    quick: bool = True,
) -> Callable[[Measure], Measure]:
    """Register a case under its function's name; ``quick`` ones run in the fast tests."""

    def register(measure: Measure) -> Measure:
        name = measure.__name__.replace("_", " ").strip()
        if name in CASES:
            raise ValueError(f"two cases are called {name!r}")
        answer = Guard(guard) if isinstance(guard, str) else guard
        CASES[name] = Case(name, room, why, holds, answer, limit, measure, quick)
        return measure

    return register


def run(what: Case, seeds: tuple[int, ...] = SEEDS) -> Result:
    """Measure a case on every seed; an exception is a failure that keeps its text."""
    worst, note, began = -math.inf, "", time.perf_counter()
    for seed in seeds:
        try:
            measured = what.measure(seed)
        except Exception as error:
            return Result(what, math.nan, note, time.perf_counter() - began, f"{type(error).__name__}: {error}"[:200])
        value, its_note = measured if isinstance(measured, tuple) else (measured, "")
        value = float(value)
        if math.isnan(value) or value > worst:
            worst, note = value, its_note
        if math.isnan(value):
            break
    return Result(what, worst, note, time.perf_counter() - began)


def not_refused(
    calls: list[Callable[[], object]], error: type[Exception] | tuple[type[Exception], ...], words: str = ""
) -> float:
    """How many calls do not end in the named error (with ``words`` in its text)."""
    missed = 0
    for call in calls:
        try:
            call()
        except error as refusal:
            missed += words.lower() not in str(refusal).lower()
        else:
            missed += 1
    return float(missed)


def non_finite(*arrays: object) -> float:
    """How many numbers are not finite."""
    import numpy as np

    return float(sum(np.count_nonzero(~np.isfinite(np.asarray(array, float))) for array in arrays))
