"""`python -m simulation trust`: claims under adversity, in lock step on all cores, resumable."""

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from simulation.cli.evaluate import PlayOptions
from simulation.closed_loop import campaign
from simulation.closed_loop.campaign import fingerprint
from simulation.closed_loop.job import Perception
from simulation.scene import drawn
from simulation.scene.worlds import files_in, load_objects, load_world
from simulation.studies import trust


@dataclass(frozen=True)
class Options(PlayOptions):
    """Play insertions with a drawn world, object, start and fault each, and count the claims that are not true.

    Results go to OUT/insertions.jsonl as they come, the report to DOCS/trust.md and .json. All figures are simulated.
    """

    out: Path = Path("runs/trust")
    docs: Path = Path("runs/trust")
    count: int = 10_000
    """insertions"""
    worlds: tuple[Path, ...] = ()
    """TOML files of worlds, or folders of them, beside the drawn ones"""
    drawn_n: int = 200
    """how many worlds are drawn by Latin hypercube"""
    layer_share: float = 0.02
    """of the drawn worlds that are played in the finer tier, which costs more"""
    seed: int = 1
    perception: tyro.conf.Suppress[Perception] = "fields"


def main(arguments: list[str]) -> int:
    """Run, print the page, write the files."""
    options = tyro.cli(Options, args=arguments, prog="tactile-insertion trust")
    options.check()
    worlds = [load_world(path) for path in files_in(options.worlds)] if options.worlds else []
    for number, tables in enumerate(drawn.draw_worlds(options.drawn_n, options.seed)):
        tables["gel"]["tier"] = "layer" if number < options.layer_share * options.drawn_n else "bristle"
        worlds.append(drawn.world(tables, f"drawn-{number:04d}"))
    setup = fingerprint({"belief": options.models})
    todo = trust.tasks(worlds, load_objects(options.objects), options.count, options.seed, options.models, "")
    campaign.claim(options.out, setup)
    rows = campaign.run(todo, options.out / "insertions.jsonl", workers=options.workers, ray=options.ray)
    sys.stdout.write(trust.write(rows, setup, options.docs))
    return 0
