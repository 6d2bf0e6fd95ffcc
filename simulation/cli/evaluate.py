"""`python -m simulation evaluate`: the paper's test protocol on all cores, resumable, as a table beside the paper's."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from service.contract.shipped import released_models
from simulation.closed_loop import campaign, statistics
from simulation.closed_loop.baselines import CONTENDERS
from simulation.closed_loop.campaign import Task
from simulation.closed_loop.statistics import OBJECTS, Row
from simulation.scene.scene import load_scene


@dataclass(frozen=True)
class Options:
    """Play insertions in lock step through the real service session, client state machine and ONNX files.

    Results go to OUT/insertions.jsonl as they come (a second call goes on where the first stopped, also after a kill),
    then to DOCS/closed_loop.md, .json and pictures. All figures are simulated.
    """

    out: Path = Path("runs/evaluation")
    """folder for results"""
    docs: Path = Path("runs/evaluation")
    """folder for the report"""
    models: Path = field(default_factory=released_models)
    """folder with the ONNX files to judge; its folder `joint` holds the joint density, if there is one"""
    paper_models: Path = Path("models/paper")
    """folder with the paper's recipe (AlexNet + LSTM); its row is left out while there is none"""
    objects: tuple[str, ...] = OBJECTS
    """scene names"""
    who: tuple[str, ...] = tuple(CONTENDERS)
    """rows of the table: the service's controllers and baselines"""
    count: int = 30
    """insertions an object for `belief`: the 4 extremes and uniform random errors"""
    baseline_count: int = 30
    """insertions an object for every other row (not more than --count)"""
    eyes: Literal["pictures", "gel"] = "pictures"
    """pictures: every frame is drawn, rectified and tracked. gel: slip from the true markers, five times cheaper"""
    seed: int = 0
    """of the start errors, grasps and noise"""
    workers: Annotated[int, tyro.conf.arg(aliases=["-j"])] = 0
    """processes; 0 takes every core"""
    note: str = ""
    """a sentence for the report, on what is special about this run"""
    ray: str = ""
    """address of a Ray cluster to work on instead of local processes ("local" starts one on this machine)"""


def folder_of(options: Options, who: str) -> Path:
    """Where a contender's networks are."""
    if who == "paper":
        return options.paper_models
    return options.models / CONTENDERS[who].folder


def entered(options: Options) -> tuple[str, ...]:
    """The contenders asked for whose networks exist; ValueError if there are none."""
    unknown = sorted(set(options.objects) - set(OBJECTS))
    if unknown:
        raise ValueError(f"--objects {', '.join(unknown)}: expected some of {', '.join(OBJECTS)}")
    unknown = sorted(set(options.who) - set(CONTENDERS))
    if unknown:
        raise ValueError(f"--who {', '.join(unknown)}: expected some of {', '.join(CONTENDERS)}")
    if options.count < 1 or options.baseline_count < 1:
        raise ValueError(f"--count {options.count} --baseline-count {options.baseline_count}: expected at least 1")
    if not list(options.models.glob("*.onnx")):
        raise ValueError(f"--models {options.models}: no *.onnx there; expected the folder with the networks")
    found = tuple(who for who in options.who if list(folder_of(options, who).glob("*.step.onnx")))
    if not found or not options.objects:
        looked = ", ".join(dict.fromkeys(str(folder_of(options, who)) for who in options.who))
        raise ValueError(f"nothing to play: expected some --objects, and --who whose *.step.onnx lie in {looked}")
    return found


def tasks(options: Options, names: tuple[str, ...]) -> list[Task]:
    """Everything to play, the n-th insertion of all before the next: a run cut short is still balanced."""
    starts = {}
    for number, scene in enumerate(OBJECTS):
        cell = load_scene(scene)
        reach = (cell.x_range_mm, cell.theta_range_deg)
        starts[scene] = statistics.start_errors(options.count, options.seed + number, reach)
    found = []
    for index in range(options.count):
        playing = names if index < options.baseline_count else tuple(who for who in names if who == "belief")
        for scene in options.objects:
            x, theta = starts[scene][index]
            job = {"scene": scene, "index": index, "x_mm": x, "theta_deg": theta, "eyes": options.eyes}
            job["seed"] = options.seed * 100_000 + index
            found += [Task(folder_of(options, who), {**job, "who": who}) for who in playing]
    return found


def main(arguments: list[str]) -> int:
    """Run, print the table, write the files; 0 also when insertions failed: the table says so."""
    options = tyro.cli(Options, args=arguments, prog="tactile-insertion evaluate")
    names = entered(options)
    setup = campaign.fingerprint({who: folder_of(options, who) for who in names})
    campaign.claim(options.out, setup)
    log = options.out / "insertions.jsonl"
    rows = campaign.run(tasks(options, names), log, workers=options.workers, ray=options.ray)
    from simulation.closed_loop.report import write

    options.docs.mkdir(parents=True, exist_ok=True)
    if "belief" in names:
        _film(options, rows)
    sys.stdout.write(write(rows, setup, options.docs, options.note))
    return 0


def _film(options: Options, rows: list[Row]) -> None:
    """The filmstrip of the first insertion of three attempts (or two) that the belief made."""
    from simulation.closed_loop.filmstrip import film
    from simulation.closed_loop.play import Job

    mine = [row for row in rows if row["who"] == "belief" and row["inserted"] and row["attempts"] in {2, 3}]
    if mine:
        row = max(mine, key=lambda found: int(found["attempts"]))
        job = {name: row[name] for name in Job.__dataclass_fields__} | {"eyes": "pictures"}
        film(Job(**job), options.models, options.docs / "closed_loop_filmstrip.png")
