"""Commands that check the physics against references and against its own guarantees."""

import json
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from reporting.files import added_rows, read_rows, write_json
from reporting.page import publish
from simulation.data.progress import progress
from simulation.data.sources import sources_sha256
from simulation.scene.worlds import training_objects
from simulation.studies import hard_probes as probes
from simulation.studies.accuracy import PAST_TOUCHDOWN_MM, SETTINGS, THETA_DEG, X_MM, measure, probe_times
from simulation.studies.accuracy_report import accuracy_page, draw
from simulation.studies.hard_probes_report import hard_probes_page
from simulation.studies.witness import calculix, check, costs
from simulation.studies.witness.check_page import foreign_check_page


@dataclass(frozen=True)
class AccuracyOptions:
    """Measure what physics accuracy costs; write accuracy.md, accuracy.json and accuracy.png."""

    out: Path = Path("docs")
    """folder of the report"""
    repeats: int = 5
    """number of runs; the fastest counts"""


def accuracy(arguments: list[str]) -> int:
    """Measure, then write the JSON, the figure and the page."""
    options = tyro.cli(AccuracyOptions, args=arguments, prog="tactile-insertion accuracy")
    if options.repeats < 1 or not options.out.is_dir():
        raise ValueError(f"expected --repeats >= 1 and an existing folder, got {options.repeats} and {options.out}")
    with progress("pokes", len(training_objects()) * len(SETTINGS)) as show:
        costs = [asdict(cost) for cost in measure(options.repeats, show)]
    poke = {"x_mm": X_MM, "theta_deg": THETA_DEG, "past_touchdown_mm": PAST_TOUCHDOWN_MM}
    data = {"poke": poke, "costs": costs, "probe_ms": probe_times(options.repeats)}
    draw(costs, options.out / "accuracy.png")
    print(publish(options.out, "accuracy", accuracy_page(data), data))
    return 0


@dataclass(frozen=True)
class HardProbeOptions:
    """Run random hard probes: all objects, gel friction 0 to 2, soft and hard blocks, weak grips, coarse load steps.

    Prints how the probes ended, and the worst residual and friction cone of the solved ones. Exits with status 2 if a
    probe reported as solved is not finite, not balanced or outside a cone. The same seed gives the same probes. With
    --out the page is written, and an interrupted run resumes if the physics is unchanged.
    """

    count: Annotated[int, tyro.conf.arg(aliases=["-n"])] = 10_000
    """number of probes"""
    seed: int = 12
    """seed of the probes; number k of a seed is always the same probe"""
    tier: Literal["bristle", "layer", "foreign"] = "bristle"
    """pads to press with; foreign: finite elements, of rubber that ends 1 mm beyond the markers"""
    workers: Annotated[int, tyro.conf.arg(aliases=["-j"])] = 0
    """processes; 0 uses all cores"""
    out: Path | None = None
    """folder for hard_probes.TIER.json and, except for foreign, hard_probes.md; default: print only"""


def hard_probes(arguments: list[str]) -> int:
    """Run the probes that an earlier call has not done, and write how all of them ended."""
    options = tyro.cli(HardProbeOptions, args=arguments, prog="tactile-insertion hard-probes")
    if options.count < 1 or options.workers < 0:
        raise ValueError(f"expected --count >= 1 and --workers >= 0, got {options.count} and {options.workers}")
    if options.out is not None and not options.out.is_dir():
        raise ValueError(f"--out {options.out}: no such folder")
    path = None if options.out is None else options.out / f"hard_probes.{options.tier}.json"
    setup = {"seed": options.seed, "tier": options.tier, "physics": sources_sha256("simulation.studies.hard_probes")}
    tally = _begun(path, setup, options.count)
    done = tally.ended.total()
    try:
        with progress("hard probes", options.count) as show:
            for part in probes.run(options.count, options.seed, options.tier, options.workers, done):
                tally.add(part)
                show(tally.ended.total())
                if path is not None:
                    write_json(path, {**setup, **tally.as_dict()})
    except probes.ImpossibleStateError as error:
        raise ValueError(f"a promise is broken: {error}") from error
    text = hard_probes_page({**setup, **tally.as_dict()})
    print(text if options.out is None or options.tier == "foreign" else publish(options.out, "hard_probes", text))
    return 0


def _begun(path: Path | None, setup: dict[str, Any], count: int) -> probes.Tally:
    """The results of an earlier run of the same probes on the same physics, or an empty tally."""
    if path is None or not path.is_file():
        return probes.Tally()
    try:
        kept = json.loads(path.read_text())
        same = all(kept.get(name) == value for name, value in setup.items())
        return probes.Tally.from_dict(kept) if same and kept["probes"] <= count else probes.Tally()
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path} is not what an earlier run left ({error!r}); remove it") from error


@dataclass(frozen=True)
class ForeignCheckOptions:
    """Check the foreign cell's finite elements against CalculiX (`ccx`), and all tiers against the finest mesh.

    Rows go to RUNS as they come; the same command resumes if the code is unchanged. The page and its data are
    foreign_check.md and .json. Without `ccx` nothing is done.
    """

    out: Path = Path("docs")
    """folder of the report"""
    runs: Path = Path("runs/foreign_check")
    """folder of the rows"""


def foreign_check(arguments: list[str]) -> int:
    """Run CalculiX, measure, then write the page."""
    options = tyro.cli(ForeignCheckOptions, args=arguments, prog="tactile-insertion foreign-check")
    if not options.out.is_dir():
        raise ValueError(f"--out {options.out}: no such folder")
    if not calculix.is_installed():
        print("foreign-check: skipped, there is no ccx here to ask (Debian: calculix-ccx)")
        return 0
    log = options.runs / f"rows-{sources_sha256('simulation.studies.witness.check')[:12]}.jsonl"
    parts: list[tuple[str, list[Any]]] = [
        ("probes", [partial(check.tried, probe) for probe in check.PROBES]),
        ("large", [partial(check.large, probe) for probe in check.LARGE]),
        ("costs", [partial(costs.measured, name, probe) for name, probe in costs.EDGES.items()]),
    ]
    data = _kept_rows(log, parts)
    before = options.out / "foreign_check.json"
    kept = json.loads(before.read_text()) if before.is_file() else {}
    hard = options.out / "hard_probes.foreign.json"
    data |= {name: kept[name] for name in ("note", "lacks") if name in kept}
    data["hard"] = json.loads(hard.read_text()) if hard.is_file() else kept.get("hard")
    print(publish(options.out, "foreign_check", foreign_check_page(data), data))
    return 0


def _kept_rows(log: Path, parts: list[tuple[str, list[Any]]]) -> dict[str, Any]:
    """The rows of every part, by name; rows already in the log are not recomputed."""
    data: dict[str, Any] = {}
    with added_rows(log) as add, progress("probes", sum(len(todo) for _, todo in parts)) as show:
        done = {(each["part"], each["number"]): each["rows"] for each in read_rows(log)}
        for name, todo in parts:
            for number, make in enumerate(todo):
                if (name, number) not in done:
                    made = make()
                    done[name, number] = [made] if isinstance(made, dict) else list(made)
                    add({"part": name, "number": number, "rows": done[name, number]})
                show(len(done))
            data[name] = [row for number in range(len(todo)) for row in done[name, number]]
    return data
