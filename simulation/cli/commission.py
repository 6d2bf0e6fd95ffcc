"""`commission`: cells that probe, adapt and learn from work; `scene`: what its presses say about a gel."""

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from reporting.files import write_durably, write_json
from reporting.page import publish
from service.contract.shipped import released_models
from simulation.closed_loop import campaign
from simulation.data.sources import sources_sha256
from simulation.scene.scene import Scene, SceneError
from simulation.scene.worlds import World, files_in, load_objects, load_scene, load_world
from simulation.studies.commissioning import Cell, Plan, commission, mistaken
from simulation.studies.commissioning_page import commissioning_page
from simulation.studies.identify import cells as pressing
from simulation.studies.identify import posterior, study
from simulation.studies.identify.page import identify_page

PLAYED_BY = "simulation.studies.identify.cells"
FIRST_COARSE, FIRST_FINE, FIRST_LAYER, FIRST_FRESH = 1000, 5000, 7000, 910_000
"""Numbers of the first cells that the posterior is fitted to, and of the first that it is judged on."""


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
    """file for the rows; insertions are kept next to it"""
    cell: Literal["own", "foreign"] = "own"
    """whose mechanics: the project's own, or finite elements that it was not built on"""
    mistakes: bool = False
    """also ask each world for its signs with each mistake of a first day"""
    probes: int = 150
    """probes of known error in each world; 0: only the four that ask for signs"""
    around: int = 300
    """presses simulated around what is known of the cell: its objects, grip and height; 0: none"""
    work: int = 50
    """working insertions to learn from; 0: none"""
    insertions: int = 50
    """fresh ones that every version is counted on"""
    seed: int = 0
    """of starts, grasps and noise"""
    models: Path = field(default_factory=released_models)
    """folder with the networks to begin with"""
    checkpoint: Path | None = None
    """release that is adapted; default: the one next to the models"""
    workers: int = 0
    """processes; 0 takes every core"""
    docs: Path | None = None
    """also write commissioning.md and its data into this folder"""


def main(arguments: list[str]) -> int:
    """Play all worlds, write the rows as they come."""
    options = tyro.cli(Options, args=arguments, prog="tactile-insertion commission")
    if min(options.probes, options.around, options.work) < 0 or options.insertions < 1:
        given = f"--probes {options.probes} --around {options.around} --work {options.work}"
        raise ValueError(f"{given} --insertions {options.insertions}: expected at least 0, 0, 0 and 1")
    models = options.models
    checkpoint = options.checkpoint or models / "checkpoint.pt"
    if not checkpoint.exists():
        raise ValueError(f"--checkpoint {checkpoint}: no such file; expected the release as `training` saved it")
    counts = options.probes, options.insertions, options.workers, options.work, options.around
    plan = Plan(checkpoint, models, *counts)
    made_by = campaign.made_by({"belief": models})
    worlds = [load_world(file) for file in files_in(options.worlds)]
    cells = [(_cell(options, world, made_by), plan) for world in worlds]
    if options.mistakes:
        wrong = [one for world in worlds for one in mistaken(world)]
        cells += [(_cell(options, world, made_by), replace(plan, probes=0)) for world in wrong]
    rows = []
    for cell, its_plan in cells:
        rows.append(commission(cell, its_plan))
        write_json(options.json, rows)
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


@dataclass(frozen=True)
class Identify:
    """Estimate gel and friction of a cell from the recordings of its commissioning; write them as a world file.

    It takes the four probes that ask for signs, and two presses until slip at each of two grips. Beside the file comes
    the same as JSON, with 90 % intervals. What the presses do not tell has an interval as wide as that of drawn cells.
    """

    recordings: Annotated[Path, tyro.conf.Positional]
    """folder with the service's recordings, those of both grips"""
    object: str
    """what was held: an object by name or TOML file, a rectangle that covers the pads"""
    out: Path
    """world file to write"""
    posterior: Path = posterior.SHIPPED
    """the one to take, unless that which ships"""


@dataclass(frozen=True)
class Play:
    """What plays drawn cells."""

    out: Path = Path("runs/identify")
    """folder for the insertions; the same command continues after an interruption"""
    models: Path = field(default_factory=released_models)
    """networks that decide the probes; nothing of what they say is used"""
    workers: int = 0
    """processes; 0 takes every core"""


@dataclass(frozen=True)
class Fit(Play):
    """Fit the posterior to drawn cells, anew: what ships is made so."""

    coarse_cells: int = 306
    """cells on coarser pads, which the intervals are not calibrated on"""
    cells: int = 300
    layer_cells: int = 44
    to: Path = Path("runs/identify/posterior.npz")
    """file to write"""


@dataclass(frozen=True)
class Evaluate(Play):
    """Judge the posterior on fresh drawn cells: does a 90 % interval hold the truth in 90 of 100?"""

    first: int = FIRST_FRESH
    """number of the first cell; none of those that it was fitted to"""
    cells: int = 60
    layer_cells: int = 0
    """as many further cells of the finer tier, which cost many times as much"""
    posterior: Path = posterior.SHIPPED
    docs: Path | None = None
    """also write identify.md and its data into this folder"""
    note: str = ""
    """prose for the page"""


def scene(arguments: list[str]) -> int:
    """`identify`, `fit` or `judge`."""
    commands: dict[str, Callable[..., Any]] = {"identify": Identify, "fit": Fit, "judge": Evaluate}
    options = tyro.extras.subcommand_cli_from_dict(commands, args=arguments, prog="tactile-insertion scene")
    match options:
        case Identify():
            _identify(options)
        case Fit():
            _fit(options)
        case Evaluate():
            _evaluate(options)
    return 0


def _identify(options: Identify) -> None:
    fitted = posterior.load(options.posterior)
    grip_n, intervals = study.identified(options.recordings, load_scene(options.object), fitted)
    comment = f"Identified from {options.recordings.name}, held: {options.object}, at {grip_n:g} N."
    write_durably(options.out, study.world_file(grip_n, intervals, comment).encode())
    write_json(options.out.with_suffix(".json"), study.as_json(grip_n, intervals, fitted))
    for one in intervals:
        print(f"{one.key:<24} {one.estimate:8.3g}   {study.range_text(one)}")
    print(f"written: {options.out}")


def _cells(options: Play, first: int, count: int, play: pressing.Play, tier: str = "bristle") -> list[pressing.Cell]:
    numbers = range(first, first + count)
    return [pressing.Cell(n, options.out / f"{tier}-{n:07d}", options.models, play, tier) for n in numbers]


def _fit(options: Fit) -> None:
    cells = _cells(options, FIRST_COARSE, options.coarse_cells, "coarse")
    cells += _cells(options, FIRST_FINE, options.cells, "closer")
    cells += _cells(options, FIRST_LAYER, options.layer_cells, "closer", "layer")
    about = {
        "made_by": "python -m simulation scene fit"
        f" --coarse-cells {options.coarse_cells} --cells {options.cells} --layer-cells {options.layer_cells}",
        "physics": sources_sha256(PLAYED_BY),
        "simulated": True,
    }
    options.to.parent.mkdir(parents=True, exist_ok=True)
    made = study.fitted(list(study.played(cells, options.workers)), about)
    made.save(options.to)
    print(json.dumps(dict(made.about)))


def _evaluate(options: Evaluate) -> None:
    cells = _cells(options, options.first, options.cells, "whole")
    cells += _cells(options, options.first, options.layer_cells, "whole", "layer")
    fitted = posterior.load(options.posterior)
    rows = [study.scored(row, fitted) for row in study.played(cells, options.workers)]
    data = {"simulated": True, "note": options.note, "posterior": dict(fitted.about), "rows": rows}
    options.out.mkdir(parents=True, exist_ok=True)
    write_json(options.out / "judged.json", data)
    page = identify_page(data)
    if options.docs:
        publish(options.docs, "identify", page, data)
    print(page)
