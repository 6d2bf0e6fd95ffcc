"""Every fault in each of its phases, stored row by row, so that an interrupted campaign can resume."""

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from reporting.files import read_rows
from service.contract.shipped import released_models
from simulation.cell.run import RunOptions
from simulation.studies.motion_bounds.faults import FAULTS, Fault, Phase
from simulation.studies.motion_bounds.play import row_of


@dataclass(frozen=True)
class BoundsOptions:
    """Inject faults into live insertions; write motion_bounds.md and .json. Fails if a bound does not hold."""

    out: Path = Path("docs")
    """folder of the page"""
    runs: Path = Path("runs/motion-bounds")
    """folder of the faulty insertions and their rows; existing rows are not measured again"""
    models: Path = field(default_factory=released_models)
    """folder with the networks"""
    only: str = ""
    """measure only faults whose name contains this, and write no page"""


def cases(only: str = "") -> list[tuple[Fault, Phase]]:
    return [(fault, phase) for fault in FAULTS for phase in fault.phases if only in fault.name]


def rows_in(runs: Path) -> dict[tuple[str, str], dict[str, Any]]:
    """The rows measured so far, by fault and phase."""
    return {(row["fault"], row["phase"]): row for row in read_rows(runs / "rows.jsonl")}


def measure(options: BoundsOptions, tell: Callable[[str], None]) -> list[dict[str, Any]]:
    """All rows, in the order of the cases; raises ChildError if a cell cannot be started."""
    done = rows_in(options.runs)
    todo = [case for case in cases(options.only) if (case[0].name, case[1]) not in done]
    options.runs.mkdir(parents=True, exist_ok=True)

    for case in todo:
        row = row_of(*case, RunOptions(models=options.models), options.runs)
        with (options.runs / "rows.jsonl").open("a") as file:
            file.write(json.dumps(row) + "\n")
        tell(f"{row['fault']}, {row['phase']}: {row['travel_mm']:.2f} mm, {row['force_n']:.1f} N, {row['ended']}")
    done = rows_in(options.runs)
    return [done[fault.name, phase] for fault, phase in cases(options.only)]
