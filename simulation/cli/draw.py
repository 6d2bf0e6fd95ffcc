"""`python -m simulation draw-worlds` and `draw-objects`: files that `evaluate --worlds --objects` plays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import tyro

from simulation.scene import drawn
from simulation.scene.rubber import shear_reach_pitches
from simulation.scene.worlds import World, load_scene


@dataclass(frozen=True)
class DrawOptions:
    """Write files NAME-0000.toml, NAME-0001.toml, ... over the ranges that cells have. Same seed, same files."""

    out: Path
    """new or empty folder"""
    count: int = 300
    """how many"""
    seed: int = 0
    """of the draw"""


def _write(options: DrawOptions, kind: str, tables: list[drawn.Tables], comment: Callable[[World], str]) -> int:
    if options.out.exists() and any(options.out.iterdir()):
        raise ValueError(f"--out {options.out}: not empty; nothing is overwritten")
    options.out.mkdir(parents=True, exist_ok=True)
    for number, each in enumerate(tables):
        name = f"{kind}-{options.seed}-{number:04d}"
        said = comment(drawn.world(each, name)) if kind == "world" else f"drawn with seed {options.seed}"
        (options.out / f"{name}.toml").write_text(drawn.toml(each, said), encoding="utf-8")
    print(f"{len(tables)} {kind}s under {options.out}")
    return 0


def draw_worlds(arguments: list[str]) -> int:
    """Write worlds by Latin hypercube."""
    options = tyro.cli(DrawOptions, args=arguments, prog="tactile-insertion draw-worlds")
    box = load_scene("rectangle")

    def comment(world: World) -> str:
        reach = shear_reach_pitches(world.around(box))
        return f"drawn with seed {options.seed}; a flat object slides after {reach:.2f} marker pitches of shear"

    return _write(options, "world", drawn.draw_worlds(options.count, options.seed), comment)


def draw_objects(arguments: list[str]) -> int:
    """Write random convex objects."""
    options = tyro.cli(DrawOptions, args=arguments, prog="tactile-insertion draw-objects")
    return _write(options, "object", drawn.draw_objects(options.count, options.seed), lambda _: "")
