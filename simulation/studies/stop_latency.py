"""`python -m simulation stop-report`: how soon the arm stops for slip, through the whole live loop, for each lag of it.

Cell, service and client run as processes and insert an object; the cell times each stop from the sending of the frame
that shows slip to the last lowered target at the controller, and to standstill.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import median
from typing import Any, Literal, NamedTuple

import tyro

from service.contract.shipped import released_models
from simulation.cell.children import ChildError, terminate_as_interrupt
from simulation.cell.emulators.abb.rapid import REACTION_S
from simulation.cell.run import RunOptions, insert, starts


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
    models: Path = field(default_factory=released_models)
    """Folder with the networks."""
    out: Path = Path("docs/robot_stop.md")
    """Table to write."""
    runs: Path = Path("runs/stop")
    """Where the runs are kept."""


@dataclass(slots=True)
class Stops:
    """All stops of one way. Times in ms from the sending of the frame that shows slip, overtravel in mm.

    ``drawn_ms`` is from that frame's capture to its sending: what the simulator needs, and no camera.
    """

    drawn_ms: list[float] = field(default_factory=list)
    frozen_ms: list[float] = field(default_factory=list)
    rest_ms: list[float] = field(default_factory=list)
    overtravel_mm: list[float] = field(default_factory=list)

    def add(self, log: Path, truth: dict[str, Any]) -> None:
        """Take in one insertion: the client's episode log and the cell's truth."""
        entries = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()]
        seen = set()
        for message in (entry.get("event", {}).get("message", {}) for entry in entries):
            if message.get("type") == "slip" and message["attempt"] not in seen:
                seen.add(message["attempt"])
                self._stop(message, truth)
        rows = entries[-1].get("end", {}).get("rows", [])
        self.overtravel_mm += [row["overtravel_mm"] for row in rows if row["overtravel_mm"] is not None]

    def _stop(self, message: dict[str, Any], truth: dict[str, Any]) -> None:
        captured_ns = message["captured_ns"]
        sent_ns = dict(truth["frames_sent_ns"][message["finger"]]).get(captured_ns)
        stop = next((stop for stop in truth["stops"] if stop["rest_ns"] > captured_ns), None)
        if sent_ns is not None and stop is not None:
            self.drawn_ms.append((sent_ns - captured_ns) / 1e6)
            self.frozen_ms.append(max(0.0, (stop["frozen_ns"] - sent_ns) / 1e6))
            self.rest_ms.append((stop["rest_ns"] - sent_ns) / 1e6)


def row(way: Way, stops: Stops, fps: int) -> str:
    """One line of the table; the frame period is the bound of the freeze."""
    name = "EGM" if way.link == "egm" else "RAPID sockets"
    within = f"{sum(value <= 1000.0 / fps for value in stops.frozen_ms)} of {len(stops.frozen_ms)}"
    drawn, frozen, rest = (_middle(values, 0) for values in (stops.drawn_ms, stops.frozen_ms, stops.rest_ms))
    numbers = [frozen, within, rest, _middle(stops.overtravel_mm, 2), drawn]
    return f"| {name}, lag {way.lag_ms:g} ms | {' | '.join(numbers)} |"


def _middle(values: Sequence[float], digits: int) -> str:
    """Median, worst in brackets."""
    return f"{median(values):.{digits}f} ({max(values):.{digits}f})" if values else "-"


_HEAD = """# How soon the arm stops

Written by `python -m simulation stop-report`: cell, service and client as three processes on one machine, descents
at 10 mm/s, emulated arm, cameras at {fps} frames a second. Times count from the moment at which the frame that shows
slip goes onto the wire; frozen is the last lowered target at the controller, overtravel the client's own figure from
the slip message to standstill: about lag times speed. Median, worst in brackets. The simulator stamps a frame before
it computes physics and picture, which takes as long as the last column says and no camera takes; on a busy machine
everything here grows. The reaction time of a controller without EGM is assumed ({reaction:.0f} ms), not measured.

| arm | frozen, ms | within a frame ({frame:.0f} ms) | standstill, ms | overtravel, mm | frame computed, ms |
|---|---|---|---|---|---|
"""


def table(rows: Sequence[str], fps: int) -> str:
    """The report as Markdown."""
    return _HEAD.format(fps=fps, frame=1000 / fps, reaction=1000 * REACTION_S) + "\n".join([*rows, ""])


def measure(options: StopOptions, base: RunOptions) -> list[str]:
    """A line of the table for each way; raises ChildError if a process fails."""
    todo, rows = starts(base), []
    for way in WAYS:
        run = replace(base, egm_lag_ms=way.lag_ms, link=way.link)
        folder, stops = options.runs / time.strftime("%Y%m%d-%H%M%S"), Stops()
        for start in todo:
            path = folder / f"{way.link}-{way.lag_ms:g}-{start.seed}"
            insert(start, run, path)
            stops.add(path / "episode.jsonl", json.loads((path / "truth.json").read_text(encoding="utf-8")))
        rows.append(row(way, stops, options.fps))
    return rows


def main(arguments: list[str]) -> int:
    """Run every way, print the table and write it; raises ValueError on wrong input."""
    options = tyro.cli(StopOptions, args=arguments, prog="tactile-insertion stop-report", description=__doc__)
    terminate_as_interrupt()
    base = RunOptions(object=options.object, repeat=options.repeat, fps=options.fps, models=options.models)
    try:
        rows = measure(options, base)
    except ChildError as error:
        print(f"stop-report: {error}", file=sys.stderr)
        return 2 if error.code == 2 else 1
    except KeyboardInterrupt:
        print("stop-report: interrupted, everything stopped", file=sys.stderr)
        return 130
    text = table(rows, options.fps)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(text, encoding="utf-8")
    print(text)
    return 0
