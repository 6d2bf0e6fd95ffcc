"""All rooms' cases, registered by import."""

from tests.hard_cases import data, decision, doors, motion, networks, perception, physics
from tests.hard_cases.registry import CASES, Result, run

__all__ = ["CASES", "by_name", "data", "decision", "doors", "motion", "networks", "perception", "physics"]


def by_name(name: str) -> Result:
    """One case on all seeds; for a worker process."""
    return run(CASES[name])
