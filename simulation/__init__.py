"""The simulated cell: physics of the held object, gel imprints, and the real protocols on loopback."""

from pathlib import Path

from simulation.compile_cache import keep_apart

keep_apart(Path(__file__).parent)
