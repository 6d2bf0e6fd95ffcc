"""`python -m simulation pace` and `choose`: what settings cost in seconds per box, and settings for a cell's needs."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from reporting.files import read_json
from reporting.machine import commit
from service.contract.shipped import released_models
from service.durable import write_durably
from simulation.cli.drawn_worlds import drawn_objects, drawn_worlds_of
from simulation.cli.evaluate import PlayOptions
from simulation.closed_loop import benchmark, campaign
from simulation.closed_loop.job import Perception
from simulation.closed_loop.statistics import Row
from simulation.scene.worlds import World, load_objects, load_world, object_names
from simulation.studies.drawn_worlds import Start, starts
from simulation.studies.lateness import lateness, timed_each
from simulation.studies.pace import choose as choosing
from simulation.studies.pace import report
from simulation.studies.pace.kept import kept as kept_results
from simulation.studies.pace.points import POINTS, tasks

MADE_BY = "make pace"


@dataclass(frozen=True)
class Options(PlayOptions):
    """Play the same starts in drawn worlds with every choice of settings, and report the cost in seconds per box.

    Results go to OUT/insertions.jsonl as they come; the report to DOCS/pace.md, .json and .png. All are simulated.
    Markers are the true fields with the tracker's error.
    """

    out: Path = Path("runs/pace")
    docs: Path = Path("runs/pace")
    kept: Path = Path("docs")
    """folder of the other pages' results, which the figures also show"""
    count: int = 200
    """number of starts"""
    seed: int = 87
    objects: tyro.conf.Suppress[tuple[str, ...]] = PlayOptions.objects
    perception: tyro.conf.Suppress[Perception] = "fields"
    draw: bool = False
    """play nothing: rewrite the page and its figure from DOCS/pace.json"""


def main(arguments: list[str]) -> int:
    """Run, print the page, write the files."""
    options = tyro.cli(Options, args=arguments, prog="tactile-insertion pace")
    kept = kept_results(options.kept)
    if options.draw:
        data = read_json(options.docs / "pace.json", MADE_BY)
    else:
        options.check()
        worlds = drawn_worlds_of(options.count, options.seed, layer_share=0.0)
        objects = drawn_objects(options.out, options.count, options.seed)
        begun = starts(worlds, objects, options.count, options.seed)
        cells = [(start.world, start.scene) for start in begun]
        data = _played(options, begun, timed_each(cells, options.seed, options.models, options.workers))
    sys.stdout.write(report.write({**data, "kept": kept}, options.docs))
    return 0


def _played(options: PlayOptions, begun: Sequence[Start], late: Sequence[Row]) -> dict[str, Any]:
    """``late``: how each start's cell was timed."""
    if all(row["late_s"] is None for row in late):
        raise ValueError(f"in none of {len(late)} cells did presses at two speeds tell the lateness: nothing to play")
    todo = tasks(POINTS, begun, options.seed, options.models, [row["late_s"] for row in late])
    rows = options.play(todo, campaign.fingerprint(_folders(options.models)))
    return {"seed": options.seed, "commit": commit(), "late": late, **report.report_of(rows, POINTS)}


def _folders(models: Path) -> dict[str, Path]:
    """The networks of all choices, by folder name."""
    return {point.networks or "belief": models / point.networks for point in POINTS}


@dataclass(frozen=True)
class ChooseOptions:
    """Write the client settings that meet a time, a success rate and a force, or say which come nearest.

    The choices and their results come from REPORT, or are played in WORLD.
    """

    seconds_a_box: float
    """mean seconds per box, at most, by the upper end of its 95 % interval"""
    success: float = 0.9
    """share of boxes inserted, at least, by the lower end of its 95 % interval"""
    max_force: float = 50.0
    """N, at most, in 95 % of insertions"""
    world: Path | None = None
    """TOML file of your cell (docs/worlds.md): every choice is played there, on all cores, resumable"""
    objects: tuple[str, ...] = object_names()
    """what the cell packs, with --world: names, TOML files or folders of them"""
    report: Path = Path("docs/pace.json")
    """of a checkout; without one give --world"""
    out: Path = Path("pace.toml")
    """file for the settings, to be put into the client's cell.toml"""
    count: int = 100
    """insertions per choice, with --world; more show more"""


def choose(arguments: list[str]) -> int:
    """0 if a choice meets all limits, 1 if only the nearest was written."""
    options = tyro.cli(ChooseOptions, args=arguments, prog="tactile-insertion choose")
    wanted = choosing.Wanted(options.seconds_a_box, options.success, options.max_force)
    wanted.check()
    if options.world is None:
        data = read_json(options.report, f"{MADE_BY}, in a checkout; elsewhere play your cell: --world FILE")
    else:
        out = Path("runs/choose") / options.world.stem
        played = PlayOptions(out=out, docs=out, models=released_models(), objects=options.objects, count=options.count)
        played.check()
        data = _played_in(load_world(options.world), played)
    best, kept = choosing.choose(data, wanted)
    write_durably(options.out, choosing.settings_toml(best, data["insertions"]))
    print(choosing.summary(best, data["insertions"], wanted, kept=kept), f"written to {options.out}", sep="\n")
    return 0 if kept else 1


def _played_in(world: World, options: PlayOptions) -> dict[str, Any]:
    objects = load_objects(options.objects)
    benchmark.check_sensors([(world, scene) for scene in benchmark.held_in(world, objects).values()], options.models)
    begun = starts([world], list(objects), options.count, options.seed)
    return _played(options, begun, len(begun) * lateness([world], objects, options.seed, options.models, 1))
