"""`python -m simulation trackers`: what accuracy of marker tracking costs in time, on trials whose truth is known.

Each setting sees the same frames: displacement RMS at 2 and 6 grey levels of noise, slip trials judged right, and CPU
time a frame on one thread. Renews that part of OUT/slip_report.json, .md and .png, which `make tradeoff` reads.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.contract import Sensor
from service.perception.markers.field import MarkerField
from service.perception.markers.tracker import MarkerTracker, TrackerSettings
from simulation.studies.slip.baselines import LucasKanade, NearestBlob
from simulation.studies.slip.detection import Tally, Tracker, alarm_of, pictures, see
from simulation.studies.slip.trials import SlipTrial, draw_trials

NOISES_GREY = (2.0, 6.0)
MEASURED_N = 16  # slip trials whose displacements are compared with the truth at each noise
TRACKERS: dict[str, Callable[[], Tracker]] = {
    "third of the resolution": lambda: MarkerTracker(TrackerSettings(shrink=3)),
    "half resolution": lambda: MarkerTracker(TrackerSettings(shrink=2)),
    "box filters": lambda: MarkerTracker(TrackerSettings(kernel="box")),
    "standard": MarkerTracker,
    "wide paraboloid": lambda: MarkerTracker(TrackerSettings(window=5)),
    "no topology": lambda: MarkerTracker(TrackerSettings(recover=False)),
    "nearest blob (baseline)": NearestBlob,
    "Lucas-Kanade 15/2 (baseline)": lambda: LucasKanade(15, 2),
    "Lucas-Kanade 21/3 (baseline)": lambda: LucasKanade(21, 3),
}


def displacement_error_px(trial: SlipTrial, fields: Sequence[Sequence[MarkerField]]) -> NDArray[np.float64]:
    """Errors [n, 2] of the displacement since frame 0, at every tracked marker of every later frame."""
    errors = []
    sensor = trial.scene.sensor
    scale = sensor.marker_pitch_px / sensor.marker_pitch_mm
    for finger, sequence in enumerate(fields):
        if sequence[0].rest_px.size == 0:
            continue
        nodes = _nodes(sequence[0], sensor)
        for k, seen in enumerate(sequence[1:], 1):
            truth = scale * (trial.gel[k, finger, ..., :2] - trial.gel[0, finger, ..., :2])[nodes]
            off = seen.displacement_px - sequence[0].displacement_px - truth
            errors.append(off[seen.valid & sequence[0].valid])
    return np.concatenate(errors) if errors else np.zeros((0, 2))


def _nodes(field: MarkerField, sensor: Sensor) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Row and column [rows, cols] of the gel's node that each node of a tracker's grid is, laid where most rest.

    Not the nearest: a firm grasp bulges the gel by more than half a pitch before the first frame.
    """
    row, column = np.mgrid[0 : field.valid.shape[0], 0 : field.valid.shape[1]]
    away = (field.rest_px - sensor.marker_rest_px()[0, 0]) / sensor.marker_pitch_px - np.stack([column, row], -1)
    most = np.rint(np.median(away.reshape(-1, 2), axis=0)).astype(int)
    last = sensor.marker_rows - 1, sensor.marker_columns - 1
    return np.clip(row + most[1], 0, last[0]), np.clip(column + most[0], 0, last[1])


def accuracy_at_noise(
    trials: Sequence[SlipTrial], noise: float, trackers: Mapping[str, Callable[[], Tracker]] = TRACKERS
) -> dict[str, dict[str, float]]:
    """Of each tracker at a camera noise in grey levels: displacement RMS (per axis, px), share of wrong identities.

    And ``seen_share``, of how many of the markers the tracker says where they are.
    """
    errors: dict[str, list[NDArray[np.float64]]] = {name: [] for name in trackers}
    seen: dict[str, list[float]] = {name: [] for name in trackers}
    for trial in trials:
        noisy = SlipTrial(**{**_shallow(trial), "scene": trial.scene.varied({"camera.noise_grey": noise})})
        images, grid_n = pictures(noisy), trial.gel[0, 0, ..., 0].size
        for name, make in trackers.items():
            fields = see(noisy, images, make, Tally())
            errors[name].append(displacement_error_px(noisy, fields))
            seen[name] += [float(field.valid.sum()) / grid_n for sequence in fields for field in sequence[1:]]
    pitch_px = trials[0].scene.sensor.marker_pitch_px
    return {
        name: _spread(np.concatenate(errors[name]), pitch_px) | {"seen_share": float(np.mean(seen[name]))}
        for name in errors
    }


def _spread(off: NDArray[np.float64], pitch_px: float) -> dict[str, float]:
    """RMS an axis of the errors [n, 2] within a quarter pitch, and the share of those beyond: wrong identities."""
    wrong = np.linalg.norm(off, axis=1) > 0.25 * pitch_px
    rms = float(np.sqrt(np.square(off[~wrong]).mean())) if (~wrong).any() else math.nan
    return {"rms_px": rms, "wrong_share": float(wrong.mean())}


def _shallow(trial: SlipTrial) -> dict[str, Any]:
    return {name: getattr(trial, name) for name in SlipTrial.__slots__}


def compare(count: int, seed: int, fps: int, watch: Callable[[], None]) -> dict[str, Any]:
    """Every tracker on the same ``count`` trials: name -> shares with Wilson intervals, RMS px, CPU ms a frame."""
    tallies = {name: Tally() for name in TRACKERS}
    kept: list[SlipTrial] = []
    for trial in draw_trials(count, seed, fps):
        images = pictures(trial)
        for name, make in TRACKERS.items():
            tallies[name].judge(trial, alarm_of(see(trial, images, make, tallies[name])))
        if trial.label == "slip" and len(kept) < MEASURED_N:
            kept.append(trial)
        watch()
    table = {name: tallies[name].summary() for name in TRACKERS}
    for noise in NOISES_GREY:
        for name, accuracy in accuracy_at_noise(kept, noise).items():
            table[name][f"noise_{noise:.0f}"] = accuracy
    return table


def main(arguments: list[str]) -> int:
    """Compare the trackers and renew their part of the slip report."""
    parser = argparse.ArgumentParser(prog="tactile-insertion trackers", description=__doc__)
    parser.add_argument("--trials", type=int, default=80, help="trials seen by every tracker (%(default)s)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--fps", type=int, choices=(30, 60, 90), default=30)
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder of slip_report.* (%(default)s)")
    given = parser.parse_args(arguments)
    if given.trials < 1:
        raise ValueError(f"--trials {given.trials}: expected at least 1")
    path = given.out / "slip_report.json"
    if not path.is_file():
        raise ValueError(f"{path} is not there; make it with: python -m simulation slip-report --out {given.out}")
    from rich.progress import Progress

    from simulation.studies.slip.report import write

    result = json.loads(path.read_text(encoding="utf-8"))
    with Progress() as progress:
        task = progress.add_task("trackers", total=given.trials)
        result["trackers"] = compare(given.trials, given.seed, given.fps, lambda: progress.advance(task))
    path.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    print(write(result, given.out))
    return 0
