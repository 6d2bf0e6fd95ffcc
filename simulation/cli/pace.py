"""`python -m simulation pace` and `choose`: what settings cost in seconds a box, and those for what a cell needs."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from reporting.files import write_durably
from service.contract.shipped import released_models
from simulation.cli.evaluate import PlayOptions
from simulation.closed_loop import campaign
from simulation.scene.worlds import World, files_in, load_objects, load_world
from simulation.studies.pace import choose as choosing
from simulation.studies.pace import report
from simulation.studies.pace.points import POINTS, TODAY, Point, tasks

TRAINED = "the world that was trained for"


@dataclass(frozen=True)
class Options(PlayOptions):
    """Play the same starts by every choice of settings of the client, and say what each costs in seconds a box.

    Results go to OUT/insertions.jsonl as they come; the report to DOCS/pace.md, .json and .png, where sections of
    other titles are kept. All are simulated. Markers are the true fields with the tracker's error.
    """

    out: Path = Path("runs/pace")
    docs: Path = Path("runs/pace")
    count: int = 6
    """insertions an object and choice"""
    seed: int = 11
    worlds: tuple[str, ...] = ()
    """TOML files of worlds or folders of them, taken in turn; the world that was trained for if left out"""
    points: tuple[str, ...] = ()
    """names of choices to play beside what ships; all if left out"""
    title: str = TRAINED
    """section of the page"""
    draw: bool = False
    """play nothing: write the page and its figures again from DOCS/pace.json"""


def main(arguments: list[str]) -> int:
    """Run, print the page, write the files."""
    options = tyro.cli(Options, args=arguments, prog="tactile-insertion pace")
    sets = _kept(options.docs / "pace.json")
    if not options.draw:
        sets[options.title] = _played(options, options.points)
    if not sets:
        raise ValueError(f"--docs {options.docs}: no pace.json there to draw; expected one, or no --draw")
    sys.stdout.write(report.write(sets, options.docs))
    return 0


def _kept(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}


def _points(names: Sequence[str]) -> list[Point]:
    if unknown := sorted(set(names) - {point.name for point in POINTS}):
        known = "; ".join(point.name for point in POINTS)
        raise ValueError(f"--points {'; '.join(unknown)}: expected some of: {known}")
    return [point for point in POINTS if not names or point.name in {TODAY, *names}]


def _played(options: PlayOptions, names: Sequence[str]) -> dict[str, Any]:
    options.check()
    chosen = _points(names)
    worlds = [load_world(file) for file in files_in(getattr(options, "worlds", ()))] or [World()]
    todo = tasks(chosen, worlds, load_objects(options.objects), options.count, options.seed, options.models)
    folders = {point.name: task.models for point, task in zip(chosen, todo, strict=False)}
    return report.report_of(options.play(todo, campaign.fingerprint(folders)), chosen)


@dataclass(frozen=True)
class ChooseOptions:
    """Write the client's settings that keep a time, a success and a force, or say which come nearest.

    The choices and what they reached are those of REPORT, or are played in WORLD.
    """

    seconds_a_box: float
    """at most, on the mean"""
    success: float = 0.99
    """share of boxes inserted, at least"""
    max_force: float = 50.0
    """N, at most, in 95 % of insertions"""
    world: Path | None = None
    """TOML file of your cell (docs/worlds.md): every choice is played there, on all cores, resumable"""
    report: Path = Path("docs/pace.json")
    out: Path = Path("pace.toml")
    """file for the settings, to be put into the client's cell.toml"""
    count: int = 6
    """insertions an object and choice, with --world"""


def choose(arguments: list[str]) -> int:
    """0 if a choice keeps all that was asked for, 1 if only the nearest was written."""
    options = tyro.cli(ChooseOptions, args=arguments, prog="tactile-insertion choose")
    wanted = choosing.Wanted(options.seconds_a_box, options.success, options.max_force)
    if options.world is None:
        sets = _kept(options.report)
        if not sets:
            raise ValueError(f"--report {options.report}: no such file; make pace writes it")
        data = next(iter(sets.values()))
    else:
        out = Path("runs/choose") / options.world.stem
        played = Options(out=out, docs=out, models=released_models(), count=options.count, worlds=(str(options.world),))
        data = _played(played, ())
    best, kept = choosing.choose(data, wanted)
    write_durably(options.out, choosing.settings_toml(best, data["insertions"]).encode())
    print(choosing.told(best, data["insertions"], wanted, kept=kept), f"written to {options.out}", sep="\n")
    return 0 if kept else 1
