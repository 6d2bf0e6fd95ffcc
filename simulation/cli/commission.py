"""`commission`: cells that probe, adapt and learn from work; `scene`: identify a gel from its presses."""

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from reporting.files import write_json
from reporting.page import publish
from service.contract.shipped import released_models
from service.durable import write_durably
from simulation.closed_loop import benchmark, campaign
from simulation.data.sources import sources_sha256
from simulation.scene.scene import Scene, SceneError
from simulation.scene.worlds import World, files_in, load_objects, load_scene, load_world
from simulation.studies.commissioning import Cell, Plan, commission
from simulation.studies.commissioning_page import commissioning_page
from simulation.studies.identify import cells as pressing
from simulation.studies.identify import posterior, study
from simulation.studies.identify.page import identify_page
from simulation.studies.wiring import mistaken

PLAYED_BY, STORED_BY = "simulation.studies.identify.cells", "simulation.studies.episodes"
FIRST_FITTED, FIRST_LAYER, FIRST_FRESH = 1000, 7000, 920_000
"""Numbers of the first cell that the posterior is fitted to, and of the first that it is evaluated on."""


@dataclass(frozen=True)
class Options:
    """Play commissioning in each world: probes of known error, adapting, and working insertions with hindsight.

    Four probes first check the cell's wiring. Where they find a mistake, nothing else is played: counts are 0, and what
    is a mean of none is null. So it is where no insertion was blocked.

    JSON gets one row per world. `released`, `after_50`, `after_150` (after all probes) and `after_work` are counted on
    the same fresh insertions; where `verdicts` keep the release, its own counts are repeated. `accepted` is the verdict
    after all probes. `robot_minutes` are those of probes and timing presses, with the ways to the fixture. Played
    insertions are stored next to the JSON and not repeated. All figures are simulated.
    """

    worlds: tuple[str, ...]
    """TOML files of worlds, or folders of them"""
    objects: tuple[str, ...]
    """names, TOML files or folders of them"""
    json: Path
    """file for the rows; insertions are stored next to it"""
    cell: Literal["own", "foreign"] = "own"
    """mechanics: the project's own, or finite elements that it was not built on"""
    mistakes: bool = False
    """also run each good world's wiring check with each mistake of a first day"""
    probes: int = 150
    """probes of known error in each world, the four of the wiring check included; 0: only those"""
    around: int = 300
    """simulated presses around what is known of the cell (its objects, grip and height); 0: none"""
    work: int = 50
    """working insertions to learn from; 0: none"""
    insertions: int = 50
    """fresh insertions on which every version is counted"""
    seed: int = 0
    """seed of starts, grasps and noise"""
    models: Path = field(default_factory=released_models)
    """folder with the initial networks"""
    checkpoint: Path | None = None
    """release to adapt; default: the one next to the models"""
    workers: int = 0
    """processes; 0 uses all cores"""
    docs: Path | None = None
    """also write commissioning.md and its data into this folder"""


def main(arguments: list[str]) -> int:
    """Play all worlds and write the rows as they come."""
    options = tyro.cli(Options, args=arguments, prog="tactile-insertion learn-worlds")
    if min(options.probes, options.around, options.work) < 0 or options.insertions < 1:
        given = f"--probes {options.probes} --around {options.around} --work {options.work}"
        raise ValueError(f"{given} --insertions {options.insertions}: expected at least 0, 0, 0 and 1")
    if options.json.is_dir():
        raise ValueError(f"--json {options.json}: is a folder; expected a file for the rows")
    if options.probes and find_spec("torch") is None:
        raise ValueError("adapting needs torch: install the extra `training`, or play only the wiring (--probes 0)")
    models = options.models
    checkpoint = options.checkpoint or models / "checkpoint.pt"
    if not checkpoint.exists():
        raise ValueError(f"--checkpoint {checkpoint}: no such file; expected the release as `training` saved it")
    more = {"workers": options.workers, "work": options.work, "around": options.around}
    plan = Plan(checkpoint, models, options.probes, options.insertions, **more)
    made_by = f"{campaign.made_by({'belief': models})}-{sources_sha256(STORED_BY)[:12]}"
    worlds = [load_world(file) for file in files_in(options.worlds)]
    cells = [(_cell(options, world, made_by), plan) for world in worlds]
    benchmark.check_sensors([(cell.world, scene) for cell, _ in cells for scene in cell.objects.values()], models)
    good = [world for world in worlds if world.unstated.wired_right]
    if options.mistakes:
        wrong = [one for world in good for one in mistaken(world)]
        cells += [(_cell(options, world, made_by), replace(plan, probes=0)) for world in wrong]
    rows = []
    for cell, its_plan in cells:
        rows.append(commission(cell, its_plan))
        write_json(options.json, rows)
        print(json.dumps(rows[-1]))
    if options.docs:
        data = {"simulated": True, "note": "", "rows": rows, "late": [row["late"] for row in rows if "late" in row]}
        publish(options.docs, "commissioning", commissioning_page(data), data)
    return 0


def _cell(options: Options, world: World, made_by: str) -> Cell:
    """The world with the objects that can be held in it; raises SceneError where none can."""
    folder = options.json.with_name(f"{options.json.name}.insertions") / made_by / world.name / f"seed-{options.seed}"
    objects, refused = dict[str, Scene](), list[str]()
    for name, scene in load_objects(options.objects).items():
        try:
            objects[name] = world.around(scene)
        except SceneError as error:
            refused.append(str(error))
    if not objects:
        raise SceneError(f"world {world.name}: no object can be played there: {refused[0]}")
    for line in refused:
        print(f"left out: {line}", file=sys.stderr)
    seed = int(sha256(f"{options.seed} {world.name}".encode()).hexdigest()[:8], 16)  # or all worlds share their starts
    return Cell(world, objects, folder, seed, "" if options.cell == "own" else options.cell)


@dataclass(frozen=True)
class Identify:
    """Estimate gel and friction of a cell from the recordings of its commissioning; write them as a world file.

    Uses the four probes of the wiring check, and two presses until slip at each of two grips. The same goes into JSON
    next to the file, with 90 % intervals. Parameters that the presses do not determine keep intervals as wide as the
    drawn cells.
    """

    recordings: Annotated[Path, tyro.conf.Positional]
    """folder with the service's recordings, those of both grips"""
    object: str
    """held object by name or TOML file: a rectangle that covers the pads"""
    out: Path
    """world file to write"""
    posterior: Path = posterior.SHIPPED
    """posterior to use; default: the released one"""


@dataclass(frozen=True)
class Play:
    """Options for playing drawn cells."""

    out: Path = Path("runs/identify")
    """folder for the insertions; the same command continues after an interruption, with the same code"""
    models: Path = field(default_factory=released_models)
    """networks that decide the probes; their answers are not used"""
    workers: int = 0
    """processes; 0 uses all cores"""


@dataclass(frozen=True)
class Fit(Play):
    """Fit the posterior to drawn cells, as the released one was."""

    cells: int = 600
    layer_cells: int = 200
    """further cells of the finer tier, which take three times as long"""
    to: Path = Path("runs/identify/posterior.npz")
    """file to write"""


@dataclass(frozen=True)
class Evaluate(Play):
    """Evaluate the posterior on fresh drawn cells: does a 90 % interval contain the truth in 90 of 100?"""

    first: int = FIRST_FRESH
    """number of the first cell; outside the fitted ones"""
    cells: int = 60
    layer_cells: int = 40
    """further cells of the finer tier"""
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
    options.out.parent.mkdir(parents=True, exist_ok=True)
    write_durably(options.out, study.world_file(grip_n, intervals, comment))
    write_json(options.out.with_suffix(".json"), study.as_json(grip_n, intervals, fitted))
    for one in intervals:
        print(f"{one.key:<24} {one.estimate:8.3g}   {study.range_text(one)}")
    print(f"written: {options.out}")


def _cells(options: Play, first: int, count: int, tier: str = "bristle") -> list[pressing.Cell]:
    numbers, folder = range(first, first + count), options.out / sources_sha256(PLAYED_BY)[:12]
    return [pressing.Cell(n, folder / f"{tier}-{n:07d}", options.models, tier) for n in numbers]


def _fit(options: Fit) -> None:
    cells = _cells(options, FIRST_FITTED, options.cells)
    cells += _cells(options, FIRST_LAYER, options.layer_cells, "layer")
    about = {
        "made_by": f"python -m simulation scene fit --cells {options.cells} --layer-cells {options.layer_cells}",
        "physics": sources_sha256(PLAYED_BY),
        "simulated": True,
    }
    options.to.parent.mkdir(parents=True, exist_ok=True)
    made = study.fitted(list(study.played(cells, options.workers)), about)
    made.save(options.to)
    print(json.dumps(dict(made.about)))


def _evaluate(options: Evaluate) -> None:
    cells = _cells(options, options.first, options.cells)
    cells += _cells(options, options.first, options.layer_cells, "layer")
    fitted = posterior.load(options.posterior)
    rows = [study.scored(row, fitted) for row in study.played(cells, options.workers)]
    data = {"simulated": True, "note": options.note, "posterior": dict(fitted.about), "rows": rows}
    options.out.mkdir(parents=True, exist_ok=True)
    write_json(options.out / "judged.json", data)
    page = identify_page(data)
    if options.docs:
        publish(options.docs, "identify", page, data)
    print(page)
