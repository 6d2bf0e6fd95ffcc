"""`python -m simulation commission`: cells that probe, adapt and learn from work, in lock step, resumable."""

from __future__ import annotations

import hashlib
import json
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import tyro

from reporting.page import publish
from service.contract.shipped import released_models
from simulation.closed_loop.campaign import fingerprint
from simulation.scene.scene import Scene, SceneError
from simulation.scene.worlds import World, files_in, load_objects, load_world
from simulation.studies.commissioning import Cell, Plan, commission, mistaken, write
from simulation.studies.commissioning_page import commissioning_page


@dataclass(frozen=True)
class Options:
    """Play commissioning in each world: probes of known error, adapting, and working insertions with hindsight.

    Four probes first tell whether the cell is wired as it says. Where they name a mistake, nothing else is played, and
    all counts are 0. JSON gets a row a world: `released`, `after_50`, `after_150` (after all probes) and `after_work`
    are counted on the same fresh insertions; where `verdicts` keep the release, they are its own. `accepted` is the
    verdict after all probes. What is played is kept beside it and not played again. All figures are simulated.
    """

    worlds: tuple[str, ...]
    """TOML files of worlds, or folders of them"""
    objects: tuple[str, ...]
    """names, TOML files or folders of them"""
    json: Path
    """file for the rows; what is played comes beside it"""
    cell: Literal["own", "foreign"] = "own"
    """whose mechanics: the project's own, or finite elements that it was not built on"""
    mistakes: bool = False
    """also ask each world for its signs with each mistake of a first day"""
    probes: int = 150
    """probes of known error in each world; 0: only the four that ask for signs"""
    insertions: int = 50
    """working insertions to learn from, and fresh ones that every version is counted on"""
    seed: int = 0
    """of starts, grasps and noise"""
    models: Path = field(default_factory=released_models)
    """folder with the networks to begin with"""
    checkpoint: Path | None = None
    """release that is adapted; beside the models unless given"""
    workers: int = 0
    """processes; 0 takes every core"""
    docs: Path | None = None
    """also write commissioning.md and its data into this folder"""


def main(arguments: list[str]) -> int:
    """Play all worlds, write the rows as they come."""
    options = tyro.cli(Options, args=arguments, prog="tactile-insertion commission")
    if options.probes < 0 or options.insertions < 1:
        raise ValueError(f"--probes {options.probes} --insertions {options.insertions}: expected at least 0 and 1")
    models = options.models
    checkpoint = options.checkpoint or models / "checkpoint.pt"
    if not checkpoint.exists():
        raise ValueError(f"--checkpoint {checkpoint}: no such file; expected the release as `training` saved it")
    plan = Plan(checkpoint, models, options.probes, options.insertions, options.workers)
    made_by = hashlib.sha256(json.dumps(fingerprint({"belief": models}), sort_keys=True).encode()).hexdigest()[:12]
    worlds = [load_world(file) for file in files_in(options.worlds)]
    cells = [(_cell(options, world, made_by), plan) for world in worlds]
    if options.mistakes:
        wrong = [one for world in worlds for one in mistaken(world)]
        cells += [(_cell(options, world, made_by), replace(plan, probes=0)) for world in wrong]
    rows = []
    for cell, its_plan in cells:
        rows.append(commission(cell, its_plan))
        write(rows, options.json)
        print(json.dumps(rows[-1]))
    if options.docs:
        data = {"simulated": True, "note": "", "rows": rows}
        publish(options.docs, "commissioning", commissioning_page(data), data)
    return 0


def _cell(options: Options, world: World, made_by: str) -> Cell:
    """The world with those objects that can be held in it; raises SceneError where there is none."""
    folder = options.json.with_suffix("") / made_by / world.name / f"seed-{options.seed}"
    objects, refused = dict[str, Scene](), list[str]()
    for name, scene in load_objects(options.objects).items():
        try:
            joined = world.around(scene)
            if options.cell == "foreign":
                _check_foreign(joined)
            objects[name] = joined
        except SceneError as error:
            refused.append(str(error))
    if not objects:
        raise SceneError(f"world {world.name}: no object can be played there: {refused[0]}")
    for line in refused:
        print(f"left out: {line}", file=sys.stderr)
    return Cell(world, objects, folder, options.seed, "" if options.cell == "own" else options.cell)


def _check_foreign(scene: Scene) -> None:
    from simulation.foreign.cell import pad_of  # brings scipy and scikit-fem

    pad_of(scene)
