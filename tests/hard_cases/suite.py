"""All rooms' cases, registered by import."""

from tests.hard_cases import data, decision, motion, networks, perception, physics
from tests.hard_cases.registry import CASES

__all__ = ["CASES", "data", "decision", "motion", "networks", "perception", "physics"]
