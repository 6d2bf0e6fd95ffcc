"""`python -m service judge`: phases of recorded grasps of real sensors, one row per run."""

import argparse
import io
import json
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import cv2

from service.contract.text import Parser
from service.tools.judge import PHASES, RATE_HZ, VIDEOS, report_of, runs_of, without_videos

_FASTEST_HZ = 1000.0


def main(arguments: Sequence[str]) -> int:
    """Judge every run and write the rows; 1 if a run could not be read in whole; raises RunError if there is none."""
    options = _parse(arguments)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a run's name may contain letters that a terminal lacks
    cv2.setNumThreads(1)  # times per frame are those of one core
    folders = _runs_in(options.folder)
    for path, nothing in ((options.out, "[]"), (options.evidence, "{}")):
        if path is not None:  # one that cannot be written is refused now, not after all runs
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(f"{nothing}\n", encoding="utf-8")
    step = max(1, round(options.fps / RATE_HZ))
    rate_hz = options.fps / step
    if rate_hz != RATE_HZ:
        print(f"{rate_hz:.3g} frames a second are judged; the limits were set at {RATE_HZ:g}", file=sys.stderr)
    rows, evidence, odd_n = [], {}, 0
    for name, folder in _named(folders, options.folder).items():
        try:
            run = report_of(folder, step, rate_hz)
        except (ValueError, cv2.error) as error:
            print(f"{name}: {error}", file=sys.stderr)
            odd_n += 1
            continue
        row = {"run": name, **run.row}
        rows.append(row)
        odd_n += row["missing_n"] > 0
        for remark in run.remarks:
            print(f"{name}: {remark}", file=sys.stderr)
        evidence[name] = run.evidence
        phases = ", ".join(f"{phase} {row[f'{phase}_frame']}" for phase in PHASES[1:])
        print(f"{name:<32} {row['frames_n']:>4} frames: {phases}; {row['ms_a_frame']:.1f} ms a frame")
        options.out.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    if options.evidence is not None:
        options.evidence.write_text(json.dumps(evidence) + "\n", encoding="utf-8")
    print(f"wrote {options.out}")
    return int(odd_n > 0)


def _runs_in(folder: Path) -> list[Path]:
    """The runs; folders that hold none where one was expected are named."""
    runs = list(runs_of(folder))
    for empty in without_videos(folder, runs):
        print(f"{empty}: no video of a finger ({', '.join(sorted(VIDEOS))}), left out", file=sys.stderr)
    return runs


def _named(runs: Sequence[Path], root: Path) -> dict[str, Path]:
    """The runs by the names of their folders, or by their paths where two folders have one name."""
    names = [run.resolve().name if run.name in {"", ".."} else run.name for run in runs]  # a link's, not its target's
    often = Counter(names)
    return {
        name if often[name] == 1 else run.relative_to(root).as_posix(): run
        for name, run in zip(names, runs, strict=True)
    }


def _parse(arguments: Sequence[str]) -> argparse.Namespace:
    description = (
        "judge recorded grasps, a folder of one video a finger each: open, contact, hold, slip, lost, released."
        " In unrectified pictures of a GelSlim of 2018 or a GelSlim 3 no frame counts as open, and no end is shown"
    )
    parser = Parser(prog="tactile-insertion judge", description=description)
    parser.add_argument("folder", type=Path, help="folder of runs, or of folders of runs")
    parser.add_argument("--json", type=Path, dest="out", default=Path("runs/judge.json"), help="file for the rows")
    parser.add_argument("--evidence", type=Path, help="file for the slide witness's readings in each frame")
    parser.add_argument(
        "--fps",
        type=_rate,
        default=RATE_HZ,
        help=f"frames per second of the videos, whatever their headers say ({RATE_HZ:g}); more are thinned out",
    )
    return parser.parse_args(arguments)


def _rate(text: str) -> float:
    rate = float(text)
    if not RATE_HZ * 0.75 <= rate <= _FASTEST_HZ:
        raise argparse.ArgumentTypeError(f"{rate:g} frames a second, expected {RATE_HZ * 0.75:g} to {_FASTEST_HZ:g}")
    return rate
