"""`python -m simulation evaluate`: the paper's test protocol on all cores, resumable, as a table beside the paper's."""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from reporting.files import write_json
from service.contract.shipped import released_models
from simulation.closed_loop import benchmark, campaign, statistics
from simulation.closed_loop.baselines import CONTROLLERS
from simulation.closed_loop.campaign import Task
from simulation.closed_loop.statistics import Row
from simulation.scene.scene import Scene
from simulation.scene.worlds import World, files_in, load_objects, load_world, object_names


@dataclass(frozen=True)
class PlayOptions:
    """What every command states that plays insertions in lock step."""

    out: Path
    """folder for results"""
    docs: Path
    """folder for the report"""
    models: Path = field(default_factory=released_models)
    """folder with the ONNX files to evaluate; its folder `joint` holds the joint density, if there is one"""
    objects: tuple[str, ...] = object_names()
    """names, TOML files or folders of them"""
    count: int = 30
    """insertions an object; for `belief` the 4 extremes and uniform random errors"""
    perception: Literal["pictures", "fields"] = "pictures"
    """pictures: every frame is drawn, rectified and tracked. fields: the true marker fields, five times cheaper"""
    seed: int = 0
    """of the start errors, grasps and noise"""
    workers: Annotated[int, tyro.conf.arg(aliases=["-j"])] = 0
    """processes; 0 takes every core"""
    ray: str = ""
    """address of a Ray cluster to work on instead of local processes ("local" starts one on this machine)"""

    def check(self) -> None:
        """Raise ValueError on a count or a folder of networks that allows nothing to be played."""
        if self.count < 1:
            raise ValueError(f"--count {self.count}: expected at least 1")
        if not list(self.models.glob("*.onnx")):
            raise ValueError(f"--models {self.models}: no *.onnx there; expected the folder with the networks")

    def play(self, todo: Sequence[Task], setup: Mapping[str, str]) -> list[Row]:
        """Rows of all tasks; those that OUT already holds of the same code and networks are kept."""
        campaign.claim(self.out, setup)
        return campaign.run(todo, self.out / "insertions.jsonl", workers=self.workers, ray=self.ray)


@dataclass(frozen=True)
class Options(PlayOptions):
    """Play insertions in lock step through the real service session, client state machine and ONNX files.

    Results go to OUT/insertions.jsonl as they come (a second call goes on where the first stopped, also after a kill),
    then to DOCS/closed_loop.md, .json and pictures. All figures are simulated.

    With --worlds and --json, every world is played with every object instead, by the first of --controllers, from
    start errors drawn uniformly; JSON gets a list of rows, one for each world and object.
    """

    out: Path = Path("runs/evaluation")
    """folder for results"""
    docs: Path = Path("runs/evaluation")
    """folder for the report"""
    paper_models: Path = Path("models/paper")
    """folder with the paper's recipe (AlexNet + LSTM); its row is left out while there is none"""
    worlds: tuple[str, ...] = ()
    """TOML files of worlds, or folders of them; needs --json"""
    cell: Literal["own", "foreign"] = "own"
    """whose mechanics, with --json: the project's own, or finite elements that it was not built on (fields only)"""
    told_reach: bool = False
    """with --json: the client tells the gel's shear reach, with the error (15 %) of a cell that has measured it"""
    json: Path | None = None
    """file for the rows; results go beside it as they come. Without --worlds: the world that was trained for"""
    controllers: tuple[str, ...] = tuple(CONTROLLERS)
    """rows of the table: the service's controllers and baselines"""
    baseline_count: int = 30
    """insertions an object for every other row (not more than --count)"""
    note: str = ""
    """a sentence for the report, on what is special about this run"""


def folder_of(options: Options, controller: str) -> Path:
    """Where a controller's networks are."""
    if controller == "paper":
        return options.paper_models
    return options.models / CONTROLLERS[controller].folder


def entered(options: Options) -> tuple[str, ...]:
    """The controllers asked for whose networks exist; ValueError if there are none."""
    unknown = sorted(set(options.controllers) - set(CONTROLLERS))
    if unknown:
        raise ValueError(f"--controllers {', '.join(unknown)}: expected some of {', '.join(CONTROLLERS)}")
    if options.baseline_count < 1:
        raise ValueError(f"--baseline-count {options.baseline_count}: expected at least 1")
    options.check()
    names = tuple(name for name in options.controllers if list(folder_of(options, name).glob("*.step.onnx")))
    if not names or not options.objects:
        looked = ", ".join(dict.fromkeys(str(folder_of(options, name)) for name in options.controllers))
        raise ValueError(
            f"nothing to play: expected some --objects, and --controllers whose *.step.onnx lie in {looked}"
        )
    return names


def tasks(options: Options, names: tuple[str, ...], objects: dict[str, Scene]) -> list[Task]:
    """Everything to play, the n-th insertion of all before the next: a run cut short is still balanced."""
    starts = {}
    for scene, cell in objects.items():
        reach = (cell.x_range_mm, cell.theta_range_deg)
        starts[scene] = statistics.start_errors(options.count, options.seed + cell.number, reach)
    todo = []
    for index in range(options.count):
        playing = names if index < options.baseline_count else tuple(name for name in names if name == "belief")
        for scene in objects:
            x, theta = starts[scene][index]
            job = {"scene": scene, "index": index, "x_mm": x, "theta_deg": theta, "perception": options.perception}
            job["seed"] = options.seed * 100_000 + index
            todo += [Task(folder_of(options, name), {**job, "controller": name}) for name in playing]
    return todo


def main(arguments: list[str]) -> int:
    """Run, print the table, write the files; 0 also when insertions failed: the table says so."""
    options = tyro.cli(Options, args=arguments, prog="tactile-insertion evaluate")
    names, objects = entered(options), load_objects(options.objects)
    setup = campaign.fingerprint({name: folder_of(options, name) for name in names})
    if options.json is not None:
        return _play_worlds(options, options.json, names[0], objects)
    if options.worlds or options.cell != "own":
        raise ValueError("--worlds, --cell: expected --json, too, the file for the rows")
    rows = options.play(tasks(options, names, objects), setup)
    from simulation.closed_loop.report import write

    options.docs.mkdir(parents=True, exist_ok=True)
    if "belief" in names:
        _film(options, rows)
    sys.stdout.write(write(rows, setup, options.docs, options.note))
    return 0


def _play_worlds(options: Options, path: Path, controller: str, objects: dict[str, Scene]) -> int:
    """Rows of every world with every object; results of other code or networks in the log are left alone."""
    worlds = [load_world(file) for file in files_in(options.worlds)] or [World()]
    models = folder_of(options, controller)
    setup = json.dumps(campaign.fingerprint({controller: models}), sort_keys=True)
    made_by = hashlib.sha256(setup.encode()).hexdigest()[:16]
    asked: dict[str, Any] = {"controller": controller, "perception": options.perception}
    if options.told_reach:
        asked["told_reach"] = True
    if options.cell == "foreign":
        if options.perception != "fields":
            raise ValueError("--cell foreign: it has no pictures of its own yet; expected --perception fields")
        asked["cell"] = "foreign"
    todo = benchmark.tasks(worlds, objects, options.count, options.seed, models, made_by, **asked)
    path.parent.mkdir(parents=True, exist_ok=True)
    log = path.with_suffix(".insertions.jsonl")
    rows = benchmark.table(campaign.run(todo, log, workers=options.workers, ray=options.ray))
    write_json(path, rows)
    for row in rows:
        inserted = f"{row['inserted']}/{row['insertions']} inserted, mean trials {row['mean_trials']:.2f}"
        print(f"{row['world']}, {row['object']}: {inserted} (simulated)")
    return 0


def _film(options: Options, rows: list[Row]) -> None:
    """The filmstrip of the first insertion of three attempts (or two) that the belief made."""
    from simulation.closed_loop.job import Job
    from simulation.studies.filmstrip import film

    mine = [row for row in rows if row["controller"] == "belief" and row["inserted"] and row["attempts"] in {2, 3}]
    if mine:
        row = max(mine, key=lambda each: int(each["attempts"]))
        job = {name: row[name] for name in Job.__dataclass_fields__} | {"perception": "pictures"}
        film(Job(**job), options.models, options.docs / "closed_loop_filmstrip.png")
