"""`python -m simulation evaluate`: every world with every object in lock step, on all cores, resumable, as rows."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from reporting.files import write_json
from service.contract.shipped import released_models
from simulation.closed_loop import benchmark, campaign
from simulation.closed_loop.campaign import Task
from simulation.closed_loop.job import Job, Outcome, Perception, Who
from simulation.closed_loop.statistics import Row, title_of
from simulation.scene.scene import Scene
from simulation.scene.worlds import World, files_in, load_objects, load_world, object_names
from simulation.studies.wiring import by_corner, felt_nothing, hung_turned, named_wirings, probes, touched


@dataclass(frozen=True)
class Played:
    """Options shared by all commands that play insertions in lock step."""

    models: Path = field(default_factory=released_models)
    """folder with the ONNX files to evaluate"""
    objects: tuple[str, ...] = object_names()
    """names, TOML files or folders of them"""
    count: int = 30
    """insertions per object"""
    perception: Perception = "pictures"
    """pictures: every frame is drawn, rectified and tracked. fields: the true marker fields, five times cheaper"""
    seed: int = 0
    """seed of the start errors, grasps and noise"""
    workers: Annotated[int, tyro.conf.arg(aliases=["-j"])] = 0
    """processes; 0 uses all cores"""
    ray: str = ""
    """address of a Ray cluster to use instead of local processes ("local" starts one on this machine)"""

    def check(self) -> None:
        """Raise ValueError if the count or the folder of networks leaves nothing to play."""
        if self.count < 1:
            raise ValueError(f"--count {self.count}: expected at least 1")
        if not self.objects:
            raise ValueError("--objects: nothing to play; expected names, TOML files or folders of them")
        if not list(self.models.glob("*.step.onnx")):
            raise ValueError(f"--models {self.models}: no *.step.onnx there; expected the folder with the networks")


@dataclass(frozen=True)
class PlayOptions(Played):
    """Options of the commands that write a page."""

    out: Path = Path("runs")
    """folder for results"""
    docs: Path = Path("runs")
    """folder for the report"""

    def play(self, todo: Sequence[Task], setup: Mapping[str, str]) -> list[Row]:
        """Rows of all tasks; OUT's rows of the same code and networks are kept."""
        campaign.claim(self.out, setup)
        return campaign.run(todo, self.out / "insertions.jsonl", workers=self.workers, ray=self.ray)


@dataclass(frozen=True)
class Options(Played):
    """Play insertions in lock step through the real service session, client state machine and ONNX files.

    Every world is played with every object, from start errors drawn uniformly. JSON gets a list of rows, one per pair
    of world and object; single insertions go to a log beside it as they come. A second call resumes the first, also
    after a kill. All figures are simulated.

    As on a real cell, four probes first check how each world is wired. Where they name a mistake, all insertions count
    as refused for it.
    """

    worlds: tuple[str, ...] = ()
    """TOML files of worlds, or folders of them; default: the project's own cell"""
    cell: Literal["own", "foreign"] = "own"
    """mechanics: the project's own, or finite elements that it was not built on"""
    controller: Who = "belief"
    """one of the service's, or the oracle, which moves by the true error (an upper bound)"""
    given_reach: bool = False
    """the client sends the gel's shear reach, with the error (15 %) of a cell that has measured it"""
    uncommissioned: bool = False
    """insert without the four probes and what they show, as `insert --live --uncommissioned` does"""
    json: Path = Path("runs/evaluation.json")
    """file for the rows"""

    def check(self) -> None:
        """Raise ValueError as for all that is played, and for a folder in place of the file."""
        super().check()
        if self.json.is_dir():
            raise ValueError(f"--json {self.json}: is a folder; expected a file for the rows")


def main(arguments: list[str]) -> int:
    """Play, write the rows and print a line for each; 0 even if insertions failed: the rows say so."""
    options = tyro.cli(Options, args=arguments, prog="tactile-insertion evaluate")
    options.check()
    todo = tasks(options)
    options.json.parent.mkdir(parents=True, exist_ok=True)
    rows = benchmark.table(_played(options, todo))
    write_json(options.json, rows)
    objects = {title_of(name): scene for name, scene in load_objects(options.objects).items()}
    for row in rows:
        print(_line(row, objects[row["object"]]))
    return 0


def tasks(options: Options) -> list[Task]:
    """Everything to play; logged results of other code or networks are ignored.

    Raises ValueError for a world whose sensor the networks do not read.
    """
    worlds, objects = _what(options)
    inside = [(world, world.around(scene)) for world, scene in product(worlds, objects.values())]
    benchmark.check_sensors(inside, options.models)
    made_by = campaign.made_by({options.controller: options.models})
    return benchmark.tasks(worlds, objects, options.count, options.seed, options.models, made_by, **_how(options))


def _what(options: Options) -> tuple[list[World], dict[str, Scene]]:
    return [load_world(file) for file in files_in(options.worlds)] or [World()], load_objects(options.objects)


def _how(options: Options) -> dict[str, Any]:
    """Fields of `Job` that all insertions share."""
    asked: dict[str, Any] = {"controller": options.controller, "perception": options.perception}
    asked |= {"given_reach": options.given_reach, "commissioned": not options.uncommissioned}
    if options.cell == "foreign":
        asked["cell"] = "foreign"
    return asked


def _played(options: Options, todo: Sequence[Task]) -> list[Row]:
    """Rows of ``todo``; where the wiring check names a mistake, nothing is played."""
    log = options.json.with_suffix(".insertions.jsonl")
    blind = options.uncommissioned or options.controller == "oracle"
    named = {} if blind else _miswired(options, todo[0].made_by, log)
    fit = [task for task in todo if task.job["condition"] not in named]
    played = iter(campaign.run(fit, log, workers=options.workers, ray=options.ray))
    return [_refused(task, cause) if (cause := named.get(task.job["condition"])) else next(played) for task in todo]


def _miswired(options: Options, made_by: str, log: Path) -> dict[str, str]:
    """Mistake of each world that has one, found with the first object whose four probes touched something.

    Where none did, one that cannot go in from there, or that was turned before it went down, tells that the blocks are
    not where they were taught.
    """
    worlds, objects = _what(options)
    named, unfelt, left = dict[str, str](), dict[str, str](), list(worlds)
    for name in by_corner(objects):
        jobs = [probes(world, name, options.seed, **_how(options)) for world in left]
        todo = [Task(options.models, job, made_by) for four in jobs for job in four]
        rows = iter(campaign.run(todo, log, workers=options.workers, ray=options.ray, title="probes of the wiring"))
        answers = [[next(rows) for _ in four] for four in jobs]
        for world, four in zip(left, answers, strict=True):
            if causes := named_wirings(four):
                named[world.name] = "; ".join(causes)
            if causes := felt_nothing(four, objects[name]) or hung_turned(four):
                unfelt[world.name] = "; ".join(causes)
        left = [world for world, four in zip(left, answers, strict=True) if not touched(four)]
        if not left:
            break
    return {world.name: unfelt[world.name] for world in left if world.name in unfelt} | named


def _refused(task: Task, cause: str) -> Row:
    """The row of an insertion into a cell whose commissioning named a mistake."""
    cause = cause.removeprefix("contradictory: ")
    outcome = Outcome.never_began(Job(**task.job), f"commissioning: contradictory: {cause}")
    return {**task.job, **asdict(outcome)}


def _line(row: Row, scene: Scene) -> str:
    paper = f"; the paper's real robot: {scene.paper.mean_trials:g}" if scene.paper else ""
    inserted = f"{row['inserted']}/{row['insertions']} inserted, mean trials {row['mean_trials']:.2f}"
    wrong = {"claimed, but not inserted": row["claimed_wrongly"]} if row["claimed_wrongly"] else {}
    ended = "".join(f"\n  {count} x {reason}" for reason, count in (wrong | row["reasons"]).items())
    return f"{row['world']}, {row['object']}: {inserted} (simulated{paper}){ended}"
