"""`python -m simulation stop-report`: how soon the arm stops for slip, through the whole live loop, for each lag of it.

Cell, service and client run as processes and insert an object; the cell times each stop from the capture of the frame
that shows slip to the last lowered target at the controller, and to standstill.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import tyro
from numpy.typing import NDArray

from simulation.emulators.abb_rapid import REACTION_S
from simulation.run import RunOptions, insert, starts
from simulation.run_children import terminate_as_interrupt
from simulation.run_report import Result


class Way(NamedTuple):
    """One way to drive the arm."""

    link: Literal["egm", "socket"]
    lag_ms: float


WAYS = (Way("egm", 20.0), Way("egm", 50.0), Way("socket", 20.0))


@dataclass(frozen=True)
class StopOptions:
    """Insert from a few starts with each way of driving the arm and tabulate the stops."""

    repeat: int = 4
    """Starts for each way, seeds counting up."""
    object: str = "rectangle"
    """Scene: a built-in name or a TOML file."""
    fps: int = 30
    """Camera rate: 30, 60 or 90."""
    models: Path = Path("models")
    """Folder with the networks."""
    out: Path = Path("docs/robot_stop.md")
    """Table to write."""
    runs: Path = Path("runs/stop")
    """Where the runs are kept."""


@dataclass(frozen=True, slots=True)
class Stops:
    """All stops of one way, in ms from the frame: message sent, target frozen, standstill; and the overtravel.

    Message and overtravel (mm from the slip message to standstill) are out of the client's episode logs.
    """

    told_ms: NDArray[np.float64]
    frozen_ms: NDArray[np.float64]
    rest_ms: NDArray[np.float64]
    overtravel_mm: NDArray[np.float64]


def stops_of(results: Sequence[Result], logs: Sequence[Path]) -> Stops:
    """Put the insertions of one way together."""
    rows = []
    for log in logs:
        last = json.loads(log.read_text(encoding="utf-8").splitlines()[-1])
        rows += last.get("end", {}).get("rows", [])
    return Stops(
        np.array([row["slip_age_ms"] for row in rows if row["slip_age_ms"] is not None]),
        np.array([value for result in results for value in result.frozen_ms]),
        np.array([value for result in results for value in result.rest_ms]),
        np.array([row["overtravel_mm"] for row in rows if row["overtravel_mm"] is not None]),
    )


def row(way: Way, stops: Stops, fps: int) -> str:
    """One line of the table; the frame period is the bound of the freeze."""
    name = "EGM" if way.link == "egm" else "RAPID sockets"
    within = f"{(stops.frozen_ms <= 1000.0 / fps).sum()} of {stops.frozen_ms.size}"
    times = (stops.told_ms, stops.frozen_ms, stops.rest_ms)
    told, frozen, rest = (_middle(values, 0) for values in times)
    numbers = [told, frozen, within, rest, _middle(stops.overtravel_mm, 2)]
    return f"| {name}, lag {way.lag_ms:g} ms | {' | '.join(numbers)} |"


def _middle(values: NDArray[np.float64], digits: int) -> str:
    """Median, worst in brackets."""
    return f"{np.median(values):.{digits}f} ({values.max():.{digits}f})" if values.size else "-"


def table(rows: Sequence[str], fps: int) -> str:
    """The report as Markdown."""
    lines = [
        "# How soon the arm stops",
        "",
        "Written by `python -m simulation stop-report`: the whole live loop on one machine, descents at 10 mm/s,",
        f"emulated arm, cameras at {fps} frames a second. Times count from the capture of the frame that shows slip,",
        "so they hold the drawing of that frame too. Told is when the service sends its message, frozen the last",
        "lowered target at the controller: their difference, the client's share, is one or two cycles of 4 ms.",
        "Overtravel is the client's own figure, from the slip message to standstill: about lag times speed. Median,",
        f"worst in brackets. The reaction time of a controller without EGM is assumed ({1000 * REACTION_S:.0f} ms),",
        "not measured.",
        "",
        f"| arm | told, ms | frozen, ms | within a frame ({1000 / fps:.0f} ms) | standstill, ms | overtravel, mm |",
        "|---|---|---|---|---|---|",
    ]
    return "\n".join([*lines, *rows, ""])


def main(arguments: list[str]) -> int:
    """Run every way, print the table and write it; raises ValueError on wrong input."""
    options = tyro.cli(StopOptions, args=arguments, prog="python -m simulation stop-report", description=__doc__)
    base = RunOptions(object=options.object, repeat=options.repeat, fps=options.fps, models=options.models)
    todo = starts(base)
    terminate_as_interrupt()
    rows = []
    for way in WAYS:
        run = replace(base, egm_lag_ms=way.lag_ms, link=way.link)
        folder = options.runs / time.strftime("%Y%m%d-%H%M%S")
        folders = [folder / f"{way.link}-{way.lag_ms:g}-{start.seed}" for start in todo]
        results = [insert(start, run, path) for start, path in zip(todo, folders, strict=True)]
        rows.append(row(way, stops_of(results, [path / "episode.jsonl" for path in folders]), options.fps))
    text = table(rows, options.fps)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(text, encoding="utf-8")
    print(text)
    return 0
