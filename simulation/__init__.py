"""The cell that is not there: physics of the held object, imprints of the gel, the real protocols on loopback."""

from pathlib import Path

from simulation.compile_cache import keep_apart

keep_apart(Path(__file__).parent)
