"""All packages' cases, registered by import."""

from tests.hard_cases.registry import CASES, run
from tests.hard_cases.rooms import (
    data,
    decision,
    doors,
    extremes,
    files,
    fits,
    histories,
    leases,
    links,
    motion,
    networks,
    perception,
    physics,
    precision,
    presses,
)

__all__ = [
    "CASES",
    "by_name",
    "data",
    "decision",
    "doors",
    "extremes",
    "files",
    "fits",
    "histories",
    "leases",
    "links",
    "motion",
    "networks",
    "perception",
    "physics",
    "precision",
    "presses",
]


def by_name(name: str) -> tuple[str, float, str, float, str]:
    """One case on all seeds, for a worker process: name, worst, note, seconds, error (a case itself cannot travel)."""
    result = run(CASES[name])
    return name, result.worst, result.note, result.seconds, result.error
