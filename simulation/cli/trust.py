"""`python -m simulation trust`: claims under adversity, in lock step on all cores, resumable."""

import json
import sys
from dataclasses import asdict, dataclass
from hashlib import sha256
from pathlib import Path

import tyro

from reporting.files import write_json
from reporting.page import publish
from simulation.cli.drawn_worlds import drawn_worlds_of
from simulation.cli.evaluate import PlayOptions
from simulation.closed_loop import benchmark, campaign
from simulation.closed_loop.job import Perception
from simulation.data.sources import sources_sha256
from simulation.scene.worlds import files_in, load_objects, load_world
from simulation.studies import trust
from simulation.studies.lateness import lateness

TIMED_BY = "simulation.studies.lateness"


@dataclass(frozen=True)
class Options(PlayOptions):
    """Play insertions, each with a drawn world, object, start and fault, and count the false claims.

    Each cell is timed first, as in a commissioning.
    """

    out: Path = Path("runs/trust")
    docs: Path = Path("runs/trust")
    count: int = 10_000
    """number of insertions"""
    worlds: tuple[Path, ...] = ()
    """TOML files of worlds, or folders of them, in addition to the drawn ones"""
    drawn_n: int = 200
    """number of worlds drawn by Latin hypercube; 0 plays only WORLDS"""
    layer_share: float = 0.02
    """share of the drawn worlds played in the finer tier, which is slower"""
    seed: int = 1
    perception: tyro.conf.Suppress[Perception] = "fields"


def main(arguments: list[str]) -> int:
    """Run, print the page, write the files."""
    options = tyro.cli(Options, args=arguments, prog="tactile-insertion trust")
    options.check()
    worlds = [load_world(path) for path in files_in(options.worlds)]
    if options.drawn_n or not worlds:
        worlds += drawn_worlds_of(options.drawn_n, options.seed, options.layer_share)
    setup = campaign.fingerprint({"belief": options.models})
    objects, path = load_objects(options.objects), options.out / "lateness.json"
    inside = [(world, scene) for world in worlds for scene in benchmark.held_in(world, objects).values()]
    benchmark.check_sensors(inside, options.models)
    timed = [asdict(world) | {"unstated": world.unstated.model_dump(mode="json")} for world in worlds]
    which = json.dumps([options.seed, timed, [scene.sha256 for scene in objects.values()], sources_sha256(TIMED_BY)])
    campaign.claim(options.out, {**setup, "worlds, objects, seed or timing": sha256(which.encode()).hexdigest()})
    if not path.exists():
        write_json(path, lateness(worlds, objects, options.seed, options.models, options.workers))
    late = json.loads(path.read_text(encoding="utf-8"))
    late_s = {row["world"]: row["late_s"] for row in late}
    todo = trust.tasks(worlds, objects, options.count, options.seed, options.models, late_s)
    data = trust.report_of(options.play(todo, setup), late, setup)
    sys.stdout.write(publish(options.docs, trust.NAME, trust.trust_page(data), data))
    return 0
