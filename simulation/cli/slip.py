"""Commands that measure slip: how well it is detected, and how soon the arm stops for it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from reporting.files import read_json
from reporting.page import publish
from simulation.cli.cell import exit_status
from simulation.data.progress import progress
from simulation.studies import stop_latency
from simulation.studies.slip import detection, grasps, real, report, trackers

NAME = "slip_report"


@dataclass(frozen=True)
class SlipOptions:
    """Measure how well slip is detected, and what that costs; write slip_report.md, .json and .png."""

    trials: int = 320
    """trials in all"""
    tradeoff: int = 80
    """trials that every tracker gets"""
    seed: int = 1
    """of the trials"""
    fps: Literal[30, 60, 90] = 30
    """camera rate"""
    out: Path = Path("docs")
    """folder of the report"""
    real: Path | None = None
    """folder of real recordings; without it their last result stays"""
    parts: tuple[Literal["trials", "trackers"], ...] = ("trials", "trackers")
    """what to measure anew; the rest stays as it is in OUT/slip_report.json"""


def slip_report(arguments: list[str]) -> int:
    """Measure the parts asked for, then write the JSON, the figure and the page."""
    options = tyro.cli(SlipOptions, args=arguments, prog="tactile-insertion slip-report")
    if options.trials < 1 or options.tradeoff < 1:
        raise ValueError(f"--trials {options.trials} --tradeoff {options.tradeoff}: expected at least 1")
    path = options.out / f"{NAME}.json"
    whole = {"trials", "trackers"} <= set(options.parts)
    data = {} if whole and not path.is_file() else read_json(path, "python -m simulation slip-report")
    if options.real is not None:
        with progress("recordings", len(real.folders_of(options.real))) as show:
            data["real"] = real.evaluate(options.real, show)
    if "trials" in options.parts:
        with progress("trials", options.trials) as show:
            data |= detection.evaluate(options.trials, options.seed, options.fps, show)
    if "trackers" in options.parts:
        with progress("trials for each tracker", options.tradeoff) as show:
            data["trackers"] = trackers.compare(options.tradeoff, options.seed, options.fps, show)
    report.draw(data["trackers"], options.out / f"{NAME}.png")
    print(publish(options.out, NAME, report.slip_page(data), data))
    return 0


@dataclass(frozen=True)
class GraspOptions:
    """Compare rows of `service judge` with labels set by eye; write real_grasps.md and .json."""

    rows: Path = Path("runs/judge.json")
    """rows of all recordings"""
    evidence: Path = Path("runs/evidence.json")
    """what the slide witness read in each frame of them"""
    labels: Path = Path("tests/service/tools/real_slips.json")
    """what is seen in each"""
    out: Path = Path("docs")
    """folder of the page"""


def real_grasps(arguments: list[str]) -> int:
    """Write the page on real grasps and print it."""
    options = tyro.cli(GraspOptions, args=arguments, prog="tactile-insertion grasps")
    rows = read_json(options.rows, "python -m service judge FOLDER")
    evidence = read_json(options.evidence, "python -m service judge FOLDER --evidence runs/evidence.json")
    data = grasps.figures(rows, read_json(options.labels, "a file of labels"), evidence)
    print(publish(options.out, "real_grasps", grasps.grasps_page(data), data))
    return 0


def stop_report(arguments: list[str]) -> int:
    """Insert with every way of driving the arm, print the page and write it; raises ValueError on wrong input."""
    options = tyro.cli(stop_latency.StopOptions, args=arguments, prog="tactile-insertion stop-report")

    def measure() -> int:
        text = stop_latency.stop_page(stop_latency.measure(options), options.fps)
        print(publish(options.out.parent, options.out.stem, text))
        return 0

    return exit_status("stop-report", measure)
