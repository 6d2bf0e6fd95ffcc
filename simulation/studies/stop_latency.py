"""How soon the arm stops for slip, through the whole live loop, for each of its lags.

Cell, service and client run as processes and insert an object; the cell times each stop from the sending of the frame
that shows slip to the last lowered target at the controller, and to standstill.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import median
from typing import Any, Literal, NamedTuple

from reporting.page import page
from reporting.table import table
from service.contract.shipped import released_models
from simulation.cell.emulators.abb.rapid import REACTION_S
from simulation.cell.run import RunOptions, Start, insert, starts


class Way(NamedTuple):
    """One way to drive the arm."""

    link: Literal["egm", "socket"]
    lag_ms: float


LINKS = {"egm": "EGM", "socket": "RAPID sockets"}
WAYS = (Way("egm", 20.0), Way("egm", 50.0), Way("socket", 20.0))


@dataclass(frozen=True)
class StopOptions:
    """Insert from a few starts with each way of driving the arm and tabulate the stops."""

    repeat: int = 4
    """Starts for each way, seeds counting up."""
    object: str = "rectangle"
    """Object by name or TOML file."""
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
        counted = set()
        for message in (entry.get("event", {}).get("message", {}) for entry in entries):
            if message.get("type") == "slip" and message["attempt"] not in counted:
                counted.add(message["attempt"])
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


def stop_page(results: Sequence[tuple[Way, Stops]], fps: int) -> str:
    """The whole of docs/robot_stop.md."""
    return page(
        f"""
        # How soon the arm stops

        Written by `python -m simulation stop-report`. Cell, service and client run as three processes on one machine,
        with an emulated arm, descents at 10 mm/s and cameras at {fps} frames a second. Times count from the moment at
        which the frame that shows slip goes onto the wire. Frozen: the last lowered target has reached the controller.
        Overtravel is the client's own figure from the slip message to standstill, about lag times speed. Medians, with
        the worst in brackets.

        The simulator stamps a frame before it computes physics and picture. That takes as long as the last column
        says; a camera does not need it. On a busy machine all times grow. The reaction time of a controller without
        EGM is assumed ({1000 * REACTION_S:.0f} ms), not measured.
        """,
        table(
            results,
            ("arm", lambda row: f"{LINKS[row[0].link]}, lag {row[0].lag_ms:g} ms"),
            ("frozen, ms", lambda row: _worst(row[1].frozen_ms, 0)),
            (f"within a frame ({1000 / fps:.0f} ms)", lambda row: _within(row[1].frozen_ms, 1000.0 / fps)),
            ("standstill, ms", lambda row: _worst(row[1].rest_ms, 0)),
            ("overtravel, mm", lambda row: _worst(row[1].overtravel_mm, 2)),
            ("frame computed, ms", lambda row: _worst(row[1].drawn_ms, 0)),
        ),
    )


def _worst(values: Sequence[float], digits: int) -> str:
    """Median, worst in brackets."""
    return f"{median(values):.{digits}f} ({max(values):.{digits}f})" if values else "-"


def _within(values: Sequence[float], limit: float) -> str:
    return f"{sum(value <= limit for value in values)} of {len(values)}"


def measure(options: StopOptions) -> list[tuple[Way, Stops]]:
    """All stops of each way; raises ChildError if a process fails."""
    base = RunOptions(object=options.object, repeat=options.repeat, fps=options.fps, models=options.models)
    todo = starts(base)
    return [(way, _insert_all(todo, replace(base, egm_lag_ms=way.lag_ms, link=way.link), options.runs)) for way in WAYS]


def _insert_all(todo: Sequence[Start], run: RunOptions, runs: Path) -> Stops:
    folder, stops = runs / time.strftime("%Y%m%d-%H%M%S"), Stops()
    for start in todo:
        path = folder / f"{run.link}-{run.egm_lag_ms:g}-{start.seed}"
        insert(start, run, path)
        stops.add(path / "episode.jsonl", json.loads((path / "truth.json").read_text(encoding="utf-8")))
    return stops
