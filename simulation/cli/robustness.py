"""`python -m simulation robustness`: what disturbances cost the closed loop, on both tiers of the gel, resumable."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from simulation.cli.evaluate import PlayOptions
from simulation.closed_loop import benchmark, campaign, robustness
from simulation.closed_loop.baselines import CONTROLLERS
from simulation.closed_loop.campaign import Task
from simulation.closed_loop.robustness import CONDITIONS, Condition
from simulation.scene.worlds import load_objects


@dataclass(frozen=True)
class Options(PlayOptions):
    """Play insertions under one disturbance after the other: noise, friction, stiffness, clearance, wear, cameras.

    Results go to OUT/insertions.jsonl as they come, the report to DOCS/robustness.md and .json. All simulated.
    """

    out: Path = Path("runs/robustness")
    docs: Path = Path("runs/robustness")
    objects: tuple[str, ...] = ("rectangle", "hexagon", "white_box")
    tiers: tuple[Literal["bristle", "layer"], ...] = ("bristle", "layer")
    """models of the gel; the networks were trained on the bristle tier"""
    only: tuple[str, ...] = ()
    """names of disturbances; all if none is given"""
    controller: str = "belief"
    """what decides the moves"""
    count: int = 10
    """insertions an object, disturbance and tier"""
    seed: int = 7


def tasks(options: Options) -> list[Task]:
    """Everything to play, the n-th insertion of all before the next: a run cut short is still balanced."""
    todo = []
    scenes = load_objects(options.objects)
    ranked = [name for name, scene in scenes.items() if scene.order is not None]
    starts = {}
    for name, scene in scenes.items():
        number = scene.number if scene.order is None else ranked.index(name)
        starts[name] = benchmark.drawn_starts(scene, options.count, options.seed + number)
    for index in range(options.count):
        for tier in options.tiers:
            for disturbance in options.only or tuple(CONDITIONS):
                condition = CONDITIONS[disturbance]
                for name, scene in scenes.items():
                    x, theta = starts[name][index]
                    job = {"scene": name, "index": index, "x_mm": x, "theta_deg": theta}
                    job |= {"controller": options.controller, "seed": options.seed * 100_000 + index}
                    job |= {"condition": robustness.label(tier, disturbance), "dead": condition.dead}
                    job |= {"changes": condition.changes(scene) | {"gel.tier": tier}}
                    job |= {"unstated": condition.unstated, "perception": _perception(options, condition)}
                    todo.append(Task(options.models / CONTROLLERS[options.controller].folder, job))
    return todo


def _perception(options: Options, condition: Condition) -> str:
    """A disturbance that shows in pictures alone has to be played with pictures."""
    return "pictures" if condition.only_in_pictures else options.perception


def main(arguments: list[str]) -> int:
    """Run, print the table, write the files."""
    options = tyro.cli(Options, args=arguments, prog="tactile-insertion robustness")
    for given, known, flag in (
        (options.only, CONDITIONS, "only"),
        ((options.controller,), CONTROLLERS, "controller"),
    ):
        unknown = sorted(set(given) - set(known))
        if unknown:
            raise ValueError(f"--{flag} {', '.join(unknown)}: expected some of {', '.join(known)}")
    options.check()
    if not options.objects or not options.tiers:
        raise ValueError("nothing to play: expected some --objects and --tiers")
    setup = campaign.fingerprint({options.controller: options.models / CONTROLLERS[options.controller].folder})
    sys.stdout.write(robustness.write(options.play(tasks(options), setup), setup, options.docs))
    return 0
