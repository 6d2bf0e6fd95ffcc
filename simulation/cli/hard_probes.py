"""`python -m simulation hard-probes`: does the physics keep its promises where contact is nasty?"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from reporting.files import write_durably
from simulation.data.progress import progress
from simulation.data.sources import sources_sha256
from simulation.studies import hard_probes


@dataclass(frozen=True)
class Options:
    """Run random hard probes: all objects, gel friction 0 to 2, soft and hard blocks, weak grips, coarse load steps.

    Prints how they ended and the worst residual and friction cone of those solved; ends with status 2 where one that
    calls itself solved is not finite, not balanced or outside a cone. The same seed gives the same probes. With --out
    a run that was interrupted goes on where it stopped, if the physics is still the same.
    """

    count: Annotated[int, tyro.conf.arg(aliases=["-n"])] = 10_000
    """probes"""
    seed: int = 12
    """of the probes; number k of a seed is always the same probe"""
    tier: Literal["bristle", "layer"] = "bristle"
    """pads to press with"""
    workers: Annotated[int, tyro.conf.arg(aliases=["-j"])] = 0
    """processes; 0 takes every core"""
    out: Path | None = None
    """folder for hard_probes.TIER.json; none: print only"""


def as_text(options: Options, result: dict[str, Any]) -> str:
    """What a person reads."""
    lines = [f"{result['probes']} hard probes, tier {options.tier}, seed {options.seed}:"]
    lines += [
        f"  {count:6d}  {100.0 * count / result['probes']:6.2f} %  {ended}" for ended, count in result["ended"].items()
    ]
    lines.append(
        f"worst residual {result['worst_residual_n']:.1e} N (limit {hard_probes.RESIDUAL_N:.0e}), worst cone violation "
        f"{result['worst_cone_violation_n_per_mm2']:.1e} N/mm2 (limit {hard_probes.CONE_N_PER_MM2:.0e}), "
        f"{result['cpu_ms_per_probe']:.0f} ms CPU a probe"
    )
    return "\n".join(lines)


def _begun(path: Path | None, asked: dict[str, Any], count: int) -> hard_probes.Tally:
    """What an earlier run of the same probes on the same physics left, or nothing."""
    if path is None or not path.is_file():
        return hard_probes.Tally()
    try:
        result = json.loads(path.read_text())
        same = all(result.get(name) == value for name, value in asked.items())
        return hard_probes.Tally.from_dict(result) if same and result["probes"] <= count else hard_probes.Tally()
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path} is not what an earlier run left ({error!r}); remove it") from error


def main(arguments: Sequence[str]) -> int:
    """Run the command line."""
    options = tyro.cli(Options, args=arguments, prog="tactile-insertion hard-probes")
    if options.count < 1 or options.workers < 0:
        raise ValueError(f"expected --count >= 1 and --workers >= 0, got {options.count} and {options.workers}")
    if options.out is not None and not options.out.is_dir():
        raise ValueError(f"--out {options.out}: no such folder")
    path = None if options.out is None else options.out / f"hard_probes.{options.tier}.json"
    asked = {"seed": options.seed, "tier": options.tier, "physics": sources_sha256("simulation.studies.hard_probes")}
    tally = _begun(path, asked, options.count)
    done = tally.ended.total()
    try:
        with progress("hard probes", options.count) as show:
            for part in hard_probes.run(options.count, options.seed, options.tier, options.workers, done):
                tally.add(part)
                show(tally.ended.total())
                if path is not None:
                    result = {**asked, **tally.as_dict()}
                    write_durably(path, (json.dumps(result, indent=1) + "\n").encode())
    except hard_probes.ImpossibleStateError as error:
        raise ValueError(f"a promise is broken: {error}") from error
    print(as_text(options, tally.as_dict()))
    return 0
