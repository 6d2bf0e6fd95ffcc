"""Every fault in each of its phases, stored row by row, so that an interrupted campaign can resume."""

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any

from reporting.files import added_rows, read_rows
from service.contract.shipped import released_models
from simulation.cell.run import RunOptions
from simulation.closed_loop.campaign import claim, fingerprint
from simulation.data.sources import ROOT
from simulation.studies.motion_bounds.faults import FAULTS, Fault, Phase
from simulation.studies.motion_bounds.play import row_of

PROGRAMS = ("simulation", "service", "robot_client")  # of a live insertion


@dataclass(frozen=True)
class BoundsOptions:
    """Inject faults into live insertions; write motion_bounds.md and .json. Fails if a bound does not hold."""

    out: Path = Path("docs")
    """folder of the page"""
    runs: Path = Path("runs/motion-bounds")
    """folder of the faulty insertions and their rows; existing rows are not measured again, those of other code or
    networks are refused"""
    models: Path = field(default_factory=released_models)
    """folder with the networks"""
    only: str = ""
    """measure only faults whose name contains this, and write no page"""
    client: Path | None = None
    """tables that override the cell's client configuration, such as a quicker descent; writes no page"""
    fps: int | None = None
    """camera rate, of which a quicker descent needs more; the sensor's if left out"""


def cases(only: str = "") -> list[tuple[Fault, Phase]]:
    return [(fault, phase) for fault in FAULTS for phase in fault.phases if only in fault.name]


def measure(options: BoundsOptions, tell: Callable[[str], None]) -> list[dict[str, Any]]:
    """All rows, in the order of the cases; raises ChildError if a cell cannot be started.

    Raises ValueError if the folder holds rows of other code or networks.
    """
    claim(options.runs, fingerprint({"release": options.models}) | {name: _code_sha256(name) for name in PROGRAMS})
    asked, run = cases(options.only), RunOptions(models=options.models, client=options.client, fps=options.fps)
    other = json.dumps([run.chosen(), run.fps], sort_keys=True) if run.client or run.fps else ""
    log = options.runs / f"rows{other and '-' + sha256(other.encode()).hexdigest()[:8]}.jsonl"
    with added_rows(log) as add:
        done = {(row["fault"], row["phase"]): row for row in read_rows(log)}
        for fault, phase in asked:
            if (fault.name, phase) not in done:
                row = done[fault.name, phase] = row_of(fault, phase, run, options.runs)
                add(row)
                tell(f"{row['fault']}, {phase}: {row['travel_mm']:.2f} mm, {row['force_n']:.1f} N, {row['ended']}")
    return [done[fault.name, phase] for fault, phase in asked]


def _code_sha256(folder: str) -> str:
    digest = sha256()
    for file in sorted((ROOT / folder).rglob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()
