"""`python -m simulation trust`: claims under adversity, in lock step on all cores, resumable."""

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from reporting.page import publish
from simulation.cli.drawn_worlds import drawn_worlds_of
from simulation.cli.evaluate import PlayOptions
from simulation.closed_loop.campaign import fingerprint
from simulation.closed_loop.job import Perception
from simulation.scene.worlds import files_in, load_objects, load_world
from simulation.studies import trust


@dataclass(frozen=True)
class Options(PlayOptions):
    """Play insertions, each with a drawn world, object, start and fault, and count the false claims."""

    out: Path = Path("runs/trust")
    docs: Path = Path("runs/trust")
    count: int = 10_000
    """number of insertions"""
    worlds: tuple[Path, ...] = ()
    """TOML files of worlds, or folders of them, in addition to the drawn ones"""
    drawn_n: int = 200
    """number of worlds drawn by Latin hypercube"""
    layer_share: float = 0.02
    """share of the drawn worlds played in the finer tier, which is slower"""
    seed: int = 1
    perception: tyro.conf.Suppress[Perception] = "fields"


def main(arguments: list[str]) -> int:
    """Run, print the page, write the files."""
    options = tyro.cli(Options, args=arguments, prog="tactile-insertion trust")
    options.check()
    worlds = [load_world(path) for path in files_in(options.worlds)]
    worlds += drawn_worlds_of(options.drawn_n, options.seed, options.layer_share)
    setup = fingerprint({"belief": options.models})
    todo = trust.tasks(worlds, load_objects(options.objects), options.count, options.seed, options.models, "")
    data = trust.report_of(options.play(todo, setup), setup)
    sys.stdout.write(publish(options.docs, trust.NAME, trust.trust_page(data), data))
    return 0
