"""`python -m simulation explain SCENE`."""

from __future__ import annotations

import argparse

from simulation.effects import EFFECTS, decide
from simulation.scene import load_scene


def main(arguments: list[str]) -> int:
    """Print each effect of a scene: on or off, and why."""
    parser = argparse.ArgumentParser(prog="python -m simulation explain", description=__doc__)
    parser.add_argument("scene", help="a built-in name (rectangle, circle, ...) or a TOML file")
    scene = load_scene(parser.parse_args(arguments).scene)
    gap = f"gap {scene.blocks.gap_mm} mm, clearance {scene.clearance_mm:.2f} mm a side"
    print(f"{scene.name}: {gap}, tier {scene.gel.tier}")
    for effect in EFFECTS:
        on, why = decide(effect, scene)
        print(f"  {'on ' if on else 'off'} {effect.key:<15} {effect.what:<52} {why}")
    return 0
