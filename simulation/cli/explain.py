"""`python -m simulation explain SCENE`."""

from __future__ import annotations

import argparse
import time

from simulation.effects import EFFECTS, decide, inertia_share
from simulation.rig import Cell
from simulation.scene import Scene, load_scene

IN_THE_PHYSICS = ("gravity", "edge_friction", "free_blocks", "gel_coupling")
REPEATS = 7


def poke_ms(scene: Scene) -> float:
    """Best CPU time of a poke 1.5 mm past touchdown, readout of every frame included, ms."""
    cell, best = Cell(scene), float("inf")
    for _ in range(REPEATS):
        cell.reset_blocks()
        cell.regrasp(0.5 * scene.x_range_mm, 4.0)
        x, y, z, _ = cell.pose
        start = time.process_time()
        for depth in (5.3, 5.6, 5.9, 6.2, 6.5):
            cell.move_to(x, y, z - depth, 4.0)
        best = min(best, 1e3 * (time.process_time() - start))
    return best


def cost(scene: Scene, key: str) -> str:
    """What an effect that is on costs a poke; images are the renderer's business."""
    if key not in IN_THE_PHYSICS:
        return "drawn with the frame"
    with_it, without = (poke_ms(scene.varied({f"effects.{key}": switch})) for switch in ("on", "off"))
    return f"{with_it - without:+.2f} of {with_it:.2f} ms a poke"


def main(arguments: list[str]) -> int:
    """Print each effect of a scene: on or off, why, and what it costs here."""
    parser = argparse.ArgumentParser(prog="python -m simulation explain", description=__doc__)
    parser.add_argument("scene", help="a built-in name (rectangle, circle, ...) or a TOML file")
    scene = load_scene(parser.parse_args(arguments).scene)
    gap = f"gap {scene.blocks.gap_mm} mm, clearance {scene.clearance_mm:.2f} mm a side"
    print(f"{scene.name}: {gap}, tier {scene.gel.tier}")
    for effect in EFFECTS:
        on, why = decide(effect, scene)
        price = cost(scene, effect.key) if on else "costs nothing"
        print(f"  {'on ' if on else 'off'} {effect.key:<15} {why:<62} {price}")
    share = inertia_share(scene)
    verdict = "negligible" if share <= 0.1 else "not negligible, and not modelled"
    print(
        f"  --  inertia         a sudden stop loads the grip to {100.0 * share:.1f} % of what it can carry: {verdict}"
    )
    return 0
