"""Cost of many cells: recordings and an adaptation measured here, and the fleet computed from them."""

import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

CELLS_N, BOXES_A_DAY, ADAPTS_FROM_N = 100, 2000, 50
"""A fleet to work out: cells, boxes that each packs a day, and recordings that each adapts to at night."""
ADAPT = ("training", "adapt", "--from", "models/pressing/checkpoint.pt")


def fleet(recordings: Path | None) -> dict[str, Any]:
    """Size of a recorded insertion, and processor time of an adaptation to a folder of them."""
    if recordings is None:
        raise RuntimeError("--recordings names no folder of recorded insertions")
    files = sorted(recordings.glob("*/insertion.mcap"))
    with tempfile.TemporaryDirectory() as out:
        cpu_s = _cpu_s(*ADAPT, str(recordings), "--out", out)
    return {
        "recordings_n": len(files),
        "insertion_mb": round(float(np.median([file.stat().st_size / 1e6 for file in files])), 1),
        "adapt_cpu_s": cpu_s,
        "cells_n": CELLS_N,
        "boxes_a_day": BOXES_A_DAY,
        "adapts_from_n": ADAPTS_FROM_N,
    }


def _cpu_s(*command: str) -> float:
    """Processor time of a module; exit status 3 is allowed, for an adaptation that leaves the release."""

    def of_children() -> float:
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        return used.ru_utime + used.ru_stime

    before = of_children()
    alone = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, "-m", *command], env=alone, capture_output=True, text=True, check=False)
    if done.returncode not in {0, 3}:
        raise RuntimeError(done.stderr[-500:])
    return round(of_children() - before, 1)


def fleet_section(facts: dict[str, Any]) -> str:
    """The arithmetic of a fleet, with its inputs; empty if these were not measured."""
    fleet, cell = (facts.get(name, {"failed": "not run"}) for name in ("fleet", "cells 1"))
    if "failed" in fleet or "failed" in cell:
        return ""
    cells, boxes = fleet["cells_n"], fleet["boxes_a_day"]
    day_gb = boxes * fleet["insertion_mb"] / 1e3
    mbit_s = cells * day_gb * 8e3 / 86_400
    adapt_s = fleet["adapt_cpu_s"] * fleet["adapts_from_n"] / fleet["recordings_n"]
    night_gb = cells * fleet["adapts_from_n"] * fleet["insertion_mb"] / 1e3
    return f"""
    ## Estimate for a fleet

    Measured: an insertion is {fleet["insertion_mb"]:g} MB (median of {fleet["recordings_n"]} simulated live ones, JPEG
    at 427 x 320; a second of 2 x 30 fps is {0.03 * cell["pair_kb"]:.1f} MB), and `training adapt` takes
    {fleet["adapt_cpu_s"]:.0f} s of one core for these. Assumed: {cells} cells, {boxes:,} boxes per cell and day, and a
    nightly adaptation to the last {fleet["adapts_from_n"]} recordings of each cell.

    - **Recordings:** {cells} x {boxes:,} = {cells * boxes:,} per day.
    - **Storage:** {boxes:,} x {fleet["insertion_mb"]:g} MB = {day_gb:.0f} GB per cell and day,
      {cells * day_gb / 1e3:.1f} TB per day for the fleet. Recordings therefore stay on the PC of the cell, where
      `--recordings-max-gb` deletes the oldest: 500 GB hold {500 / day_gb:.0f} days.
    - **Bandwidth:** sending everything takes {mbit_s:.0f} Mbit/s around the clock. The nightly adaptation needs
      {night_gb:.0f} GB, or {night_gb * 8e3 / (8 * 3600):.0f} Mbit/s over 8 hours, and nothing if the PC of each cell
      adapts its own networks.
    - **Adaptation:** {fleet["adapts_from_n"]} / {fleet["recordings_n"]} x {fleet["adapt_cpu_s"]:.0f} s = {adapt_s:.0f}
      s per cell, if it grows with the recordings; {cells * adapt_s / 3600:.1f} hours of one core for the fleet.
    """
