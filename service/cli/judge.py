"""`python -m service judge`: phases of recorded grasps of real sensors, one row per run."""

import argparse
import io
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import cv2

from service.tools.judge import PHASES, report_of, runs_of


def main(arguments: Sequence[str]) -> int:
    """Judge every run and write the rows; 1 if a run could not be read; raises RunError if there is none."""
    options = _parse(arguments)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a run's name may contain letters that a terminal lacks
    cv2.setNumThreads(1)  # times per frame are those of one core
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text("[]\n", encoding="utf-8")
    rows, evidence, unread_n = [], {}, 0
    for folder in runs_of(options.folder):
        try:
            run = report_of(folder)
        except (ValueError, cv2.error) as error:
            print(f"{folder.name}: {error}", file=sys.stderr)
            unread_n += 1
            continue
        rows.append(row := run.row)
        if len(row["fingers"]) < 2:
            print(f"{folder.name}: one finger's video alone: whether the object slides is not known", file=sys.stderr)
        evidence[row["run"]] = run.evidence
        phases = ", ".join(f"{name} {row[f'{name}_frame']}" for name in PHASES[1:])
        print(f"{row['run']:<32} {row['frames_n']:>4} frames: {phases}; {row['ms_a_frame']:.1f} ms a frame")
        options.out.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    if options.evidence is not None:
        options.evidence.write_text(json.dumps(evidence) + "\n", encoding="utf-8")
    print(f"wrote {options.out}")
    return int(unread_n > 0)


def _parse(arguments: Sequence[str]) -> argparse.Namespace:
    description = (
        "judge recorded grasps, a folder of one video a finger each: open, contact, hold, slip, lost, released"
    )
    parser = argparse.ArgumentParser(prog="tactile-insertion judge", description=description)
    parser.add_argument("folder", type=Path, help="folder of runs, or of folders of runs")
    parser.add_argument("--json", type=Path, dest="out", default=Path("runs/judge.json"), help="file for the rows")
    parser.add_argument("--evidence", type=Path, help="file for the slide witness's readings in each frame")
    return parser.parse_args(arguments)
