"""Commands that measure how well slip is detected, in simulation and on recorded grasps."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from reporting.files import read_json
from reporting.page import publish
from simulation.data.progress import progress
from simulation.studies.slip import detection, grasps, grasps_page, report, tracking


@dataclass(frozen=True)
class SlipOptions:
    """Measure how well slip is detected, and at what cost; write slip_report.md and .json."""

    trials: int = 320
    """total number of trials"""
    seed: int = 1
    """seed of the trials"""
    fps: Literal[30, 60, 90] = 30
    """camera rate"""
    out: Path = Path("docs")
    """folder of the report"""


def slip_report(arguments: list[str]) -> int:
    """Measure, then write the JSON and the page."""
    options = tyro.cli(SlipOptions, args=arguments, prog="tactile-insertion slip-report")
    if options.trials < 1:
        raise ValueError(f"--trials {options.trials}: expected at least 1")
    options.out.mkdir(parents=True, exist_ok=True)  # refused now rather than after all trials
    with progress("trials", options.trials) as show:
        data = detection.evaluate(options.trials, options.seed, options.fps, show)
    data["tracking"] = tracking.measure(options.seed, options.fps)
    print(publish(options.out, "slip_report", report.slip_page(data), data))
    return 0


@dataclass(frozen=True)
class GraspOptions:
    """Compare rows of `service judge` with labels set by eye; write real_grasps.md and .json."""

    rows: Path = Path("runs/judge.json")
    """rows of all recordings"""
    evidence: Path = Path("runs/evidence.json")
    """readings of the slide witness in each frame of them"""
    labels: Path = Path("tests/service/tools/real_slips.json")
    """labels: what is visible in each recording"""
    out: Path = Path("docs")
    """folder of the page"""


def real_grasps(arguments: list[str]) -> int:
    """Write the page on real grasps and print it."""
    options = tyro.cli(GraspOptions, args=arguments, prog="tactile-insertion grasps")
    rows = read_json(options.rows, "python -m service judge FOLDER")
    evidence = read_json(options.evidence, "python -m service judge FOLDER --evidence runs/evidence.json")
    data = grasps.figures(rows, read_json(options.labels, "a file of labels"), evidence)
    published = options.out / "real_grasps.json"
    data |= {"note": read_json(published, "this command").get("note", "") if published.exists() else ""}
    print(publish(options.out, "real_grasps", grasps_page.grasps_page(data), data))
    return 0
