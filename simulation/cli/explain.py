"""`python -m simulation explain SCENE`."""

import math
import time
from itertools import count

import numpy as np

from reporting.machine import best_cpu_ms
from service.contract.text import Parser, fitted
from simulation.closed_loop.client import PROBING_MM_S
from simulation.optics.appearance import Appearance
from simulation.optics.renderer import Renderer
from simulation.physics.quasistatic import QuasiStaticCell
from simulation.scene.effects import EFFECTS, decide
from simulation.scene.scene import Scene
from simulation.scene.worlds import World, freed, load_scene, load_world

IN_THE_PHYSICS = (
    *("gravity", "inertia", "edge_friction", "free_blocks", "gel_coupling"),
    *("poisson", "gel_edges", "relaxation", "finger_compliance"),
)
REPEATS = 7


def poke_ms(scene: Scene) -> float:
    """Best CPU time of a poke 1.5 mm past touchdown, readout of every frame included, ms; inf if no grasp held."""
    cell, best = QuasiStaticCell(scene), float("inf")
    for _ in range(REPEATS):
        cell.reset_blocks()
        cell.regrasp(0.5 * scene.x_range_mm, 4.0)
        x, y, z, _ = cell.pose
        start = time.process_time()
        for depth in (5.3, 5.6, 5.9, 6.2, 6.5):
            cell.move_to(x, y, z - depth, 4.0)
        if not cell.lost():  # a lost object is not solved for
            best = min(best, 1e3 * (time.process_time() - start))
    return best


def frame_ms(scene: Scene) -> float:
    """Best CPU time of drawing one raw frame of a gel in motion, ms."""
    renderer, numbers = Renderer(Appearance.draw(scene, "left", 0)), count()
    rows, columns = scene.sensor.marker_rows, scene.sensor.marker_columns
    gel = np.full((rows, columns, 3), 0.04, np.float32) * np.linspace(0.5, 1.0, columns, dtype=np.float32)[:, None]

    def draw_next() -> None:
        number = next(numbers)
        renderer.raw((1.0 + 0.01 * number) * gel, number, 0.5 * gel)  # a gel at rest is not drawn again

    return best_cpu_ms(draw_next, 2 * REPEATS)


def cost(scene: Scene, key: str) -> str:
    """The cost of an active effect per poke or, where it shows only in pictures, per frame."""
    if key == "dropped_frames":
        return "frames are drawn and thrown away"
    measure, unit = (poke_ms, "poke") if key in IN_THE_PHYSICS else (frame_ms, "frame")
    with_it, without = (measure(scene.varied({f"effects.{key}": switch})) for switch in ("on", "off"))
    if not math.isfinite(with_it + without):
        return "the grasp does not hold: no cost measured"
    return f"{with_it - without:+.2f} of {with_it:.2f} ms a {unit}"


def explain(arguments: list[str]) -> int:
    """Print each effect of a scene: on or off, why, and what it costs here."""
    parser = Parser(prog="tactile-insertion explain", description=explain.__doc__)
    parser.add_argument("scene", help="name of an object (rectangle, circle, ...) or a TOML file")
    parser.add_argument("--world", help="a world file (default: the project's own cell)")
    given = parser.parse_args(arguments)
    world = load_world(given.world) if given.world else World()
    scene = world.around(freed(load_scene(given.scene)))
    scene = scene.varied({"speed_mm_s": min(scene.speed_mm_s, PROBING_MM_S)})
    gap = f"gap {scene.blocks.gap_mm:g} mm, clearance {scene.clearance_mm:.2f} mm a side"
    print(f"{scene.name}: {gap}, tier {scene.gel.tier}")
    for effect in EFFECTS:
        on, why = decide(effect, scene)
        price = f"; {cost(scene, effect.key)}" if on else ""
        print(fitted(f"  {'on ' if on else 'off'} {effect.key:<17} {why}{price}", 24))
    return 0
