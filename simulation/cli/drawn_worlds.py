"""`drawn-worlds`, `sealed`: the closed loop outside the training set; `draw-worlds`, `draw-objects`: files for it."""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from reporting.files import write_csv
from reporting.page import publish
from service.contract.shipped import released_models
from service.durable import write_durably
from simulation.cli.evaluate import PlayOptions
from simulation.closed_loop import campaign
from simulation.closed_loop.job import Perception
from simulation.closed_loop.statistics import Row
from simulation.scene import drawn
from simulation.scene.rubber import shear_reach_pitches
from simulation.scene.worlds import World, load_scene
from simulation.studies import drawn_worlds
from simulation.studies.drawn_worlds import Variant
from simulation.studies.witness import sealed as test
from simulation.studies.witness.sealed_page import foreign_world_page


@dataclass(frozen=True)
class Options(PlayOptions):
    """Play the same starts in drawn worlds by every variant.

    Variants: the release with a measured shear reach and without one; the networks of OLDER and of PAPER_MODELS where
    given. Those of the paper's recipe always read pictures.

    Results go to OUT/insertions.jsonl as they come, the report to DOCS/drawn_worlds.md and .json. All are simulated.
    """

    out: Path = Path("runs/drawn_worlds")
    docs: Path = Path("runs/drawn_worlds")
    count: int = 300
    """insertions per variant"""
    objects: tyro.conf.Suppress[tuple[str, ...]] = PlayOptions.objects
    perception: Perception = "fields"
    drawn_n: int = 300
    """number of worlds drawn by Latin hypercube"""
    layer_share: float = 0.5
    """share of the drawn worlds played in the finer tier, which is slower"""
    older: Path = Path("models")
    """folder of an earlier release"""
    paper_models: Path = Path("models/paper")
    """folder with the networks of the paper's recipe"""
    seed: int = 1


def main(arguments: list[str]) -> int:
    """Run, print the page, write the files."""
    options = tyro.cli(Options, args=arguments, prog="tactile-insertion drawn-worlds")
    options.check()
    worlds = drawn_worlds_of(options.drawn_n, options.seed, options.layer_share)
    begun = drawn_worlds.starts(
        worlds, drawn_objects(options.out, options.drawn_n, options.seed), options.count, options.seed
    )
    played = _variants(options)
    setup = campaign.fingerprint({variant.title: variant.models for variant in played})
    rows = options.play(drawn_worlds.tasks(played, begun, options.seed), setup)
    data = drawn_worlds.report_of(rows, played, begun, setup)
    sys.stdout.write(publish(options.docs, drawn_worlds.NAME, drawn_worlds.drawn_worlds_page(data), data))
    return 0


def _variants(options: Options) -> list[Variant]:
    reads = options.perception
    variants = [
        Variant("release, reach given", options.models, "belief", given_reach=True, perception=reads),
        Variant("release, reach not given", options.models, "belief", given_reach=False, perception=reads),
    ]
    if list(options.older.glob("*.step.onnx")) and options.older.resolve() != options.models.resolve():
        variants.append(Variant("release before", options.older, "belief", given_reach=False, perception=reads))
    if list(options.paper_models.glob("*.step.onnx")):
        recipe = Variant(
            "the paper's recipe", options.paper_models, "heuristic", given_reach=False, perception="pictures"
        )
        variants.append(recipe)
    return variants


def drawn_worlds_of(count: int, seed: int, layer_share: float) -> list[World]:
    """``count`` drawn worlds; those of the finer tier are spread evenly, so that an interrupted run is balanced."""
    if count < 1:
        raise ValueError(f"--drawn-n {count}: expected at least 1")
    worlds = []
    for number, tables in enumerate(drawn.draw_worlds(count, seed)):
        is_layer = int((number + 1) * layer_share) > int(number * layer_share)
        tables["gel"]["tier"] = "layer" if is_layer else "bristle"
        worlds.append(drawn.world(tables, f"drawn-{number:04d}"))
    return worlds


def drawn_objects(out: Path, count: int, seed: int) -> list[str]:
    """Drawn objects as files in OUT, because a job names its object by a file."""
    folder = out / "objects"
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"object-{number:04d}.toml" for number in range(count)]
    for path, tables in zip(paths, drawn.draw_objects(count, seed), strict=True):
        write_durably(path, drawn.toml(tables, "drawn"))
    return [str(path) for path in paths]


@dataclass(frozen=True)
class SealedOptions:
    """Play the sealed test of a release: worlds and starts follow from the networks' bytes and a counter.

    Results go to OUT/insertions.jsonl as they come; the same command resumes an interrupted test, and a larger --count
    adds to it. The report goes to DOCS/foreign_world.md and .json, every insertion to .csv. All figures are simulated.
    """

    out: Path = Path("runs/sealed")
    """folder for results"""
    docs: Path = Path("runs/sealed")
    """folder for the report"""
    models: Path = field(default_factory=released_models)
    """folder of the release"""
    counter: int = 1
    """number of the test of this release; the first one counts"""
    count: int = 100
    """insertions per family, at most 500"""
    beside: tuple[Literal["bristle", "layer", "older", "recipe", "oracle"], ...] = ("bristle",)
    """what else plays the first starts: our own tiers; in finite elements OLDER, PAPER_MODELS and an oracle"""
    beside_count: int = 0
    """insertions per family for each of these, a multiple of 5; 0 for all"""
    older: Path = Path("models")
    """folder of an earlier release"""
    paper_models: Path = Path("models/paper")
    """folder with the networks of the paper's recipe"""
    workers: Annotated[int, tyro.conf.arg(aliases=["-j"])] = 0
    """processes; 0 uses all cores"""


def sealed(arguments: list[str]) -> int:
    """Play, then write the page."""
    options = tyro.cli(SealedOptions, args=arguments, prog="tactile-insertion sealed")
    if not 1 <= options.count <= test.WORLDS * test.EACH:
        raise ValueError(f"--count {options.count}: expected 1 to {test.WORLDS * test.EACH}")
    if options.beside_count % test.EACH or options.beside_count < 0:
        raise ValueError(f"--beside-count {options.beside_count}: expected a multiple of {test.EACH}, or 0 for all")
    others = _others(options)
    networks = {"release": options.models, **{str(cell): others[cell] for cell in options.beside if cell in others}}
    for name, folder in networks.items():
        if not list(folder.glob("*.step.onnx")):
            raise ValueError(f"{name}: {folder} has no *.step.onnx; expected the folder of a release")
    seal = test.seal(options.models, options.counter)
    campaign.claim(options.out, {**campaign.fingerprint(networks), "seal": seal})
    objects = drawn_objects(options.out, test.WORLDS, test.seed_of(seal, "objects"))
    begun = test.opened(seal, objects, options.count)
    played = dict(_sealed_rows(options, seal, begun))
    data = test.report_of(played, begun, {"seal": seal, "counter": options.counter, "count": options.count})
    sys.stdout.write(publish(options.docs, "foreign_world", foreign_world_page(data), data))
    write_csv(options.docs / "foreign_world.csv", test.table_of(played, begun))
    return 0


def _others(options: SealedOptions) -> dict[str, Path]:
    """The folders of networks that are not the release's, by the name of their comparison."""
    return {"older": options.older, "recipe": options.paper_models}


def _sealed_rows(options: SealedOptions, seal: str, begun: Sequence[test.Opened]) -> Iterator[tuple[str, list[Row]]]:
    """Rows of the release in the finite elements, then those of the comparisons, from the first of the same starts."""
    first = begun[: len(test.FAMILIES) * (options.beside_count or options.count)]
    for cell in (test.WITNESS, *options.beside):
        todo = test.tasks(
            seal,
            _others(options).get(cell, options.models),
            begun if cell == test.WITNESS else first,
            cell,
        )
        yield cell, campaign.run(todo, options.out / "insertions.jsonl", workers=options.workers)


@dataclass(frozen=True)
class DrawOptions:
    """Write files NAME-0000.toml, NAME-0001.toml, ... over the ranges of real cells. Same seed, same files."""

    out: Path
    """new or empty folder"""
    count: int = 300
    """number of files"""
    seed: int = 0
    """seed of the draw"""


def _write(options: DrawOptions, kind: str, tables: list[drawn.Tables], comments: list[str]) -> int:
    if options.out.exists() and any(options.out.iterdir()):
        raise ValueError(f"--out {options.out}: not empty; nothing is overwritten")
    options.out.mkdir(parents=True, exist_ok=True)
    for number, (each, comment) in enumerate(zip(tables, comments, strict=True)):
        path = options.out / f"{kind}-{options.seed}-{number:04d}.toml"
        path.write_text(drawn.toml(each, f"drawn with seed {options.seed}{comment}"), encoding="utf-8")
    print(f"{len(tables)} {kind}s under {options.out}")
    return 0


def draw_worlds(arguments: list[str]) -> int:
    """Write worlds by Latin hypercube."""
    options = tyro.cli(DrawOptions, args=arguments, prog="tactile-insertion draw-worlds")
    box, tables = load_scene("rectangle"), drawn.draw_worlds(options.count, options.seed)
    reaches = [shear_reach_pitches(drawn.world(each, "drawn").around(box)) for each in tables]
    comments = [f"; a flat object slides after {reach:.2f} marker pitches of shear" for reach in reaches]
    return _write(options, "world", tables, comments)


def draw_objects(arguments: list[str]) -> int:
    """Write random convex objects."""
    options = tyro.cli(DrawOptions, args=arguments, prog="tactile-insertion draw-objects")
    return _write(options, "object", drawn.draw_objects(options.count, options.seed), [""] * options.count)
