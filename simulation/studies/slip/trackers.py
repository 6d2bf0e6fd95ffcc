"""What accuracy of marker tracking costs in time, on trials whose truth is known.

Each setting gets the same frames: displacement RMS at 2 and 6 grey levels of noise, share of slip trials right, and CPU
time a frame on one thread.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.contract import Sensor
from service.perception.markers.field import MarkerField
from service.perception.markers.tracker import MarkerTracker, TrackerSettings
from simulation.studies.slip.baselines import LucasKanade, NearestBlob
from simulation.studies.slip.detection import Tally, Tracker, alarm_of, pictures, track
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
        for k, field in enumerate(sequence[1:], 1):
            truth = scale * (trial.gel[k, finger, ..., :2] - trial.gel[0, finger, ..., :2])[nodes]
            off = field.displacement_px - sequence[0].displacement_px - truth
            errors.append(off[field.valid & sequence[0].valid])
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

    And ``tracked_share``, the share of the markers whose place the tracker states.
    """
    errors: dict[str, list[NDArray[np.float64]]] = {name: [] for name in trackers}
    tracked: dict[str, list[float]] = {name: [] for name in trackers}
    for trial in trials:
        noisy = replace(trial, scene=trial.scene.varied({"camera.noise_grey": noise}))
        images, grid_n = pictures(noisy), trial.gel[0, 0, ..., 0].size
        for name, make in trackers.items():
            fields = track(noisy, images, make, Tally())
            errors[name].append(displacement_error_px(noisy, fields))
            tracked[name] += [float(field.valid.sum()) / grid_n for sequence in fields for field in sequence[1:]]
    pitch_px = trials[0].scene.sensor.marker_pitch_px
    return {
        name: _spread(np.concatenate(errors[name]), pitch_px) | {"tracked_share": float(np.mean(tracked[name]))}
        for name in errors
    }


def _spread(off: NDArray[np.float64], pitch_px: float) -> dict[str, float]:
    """RMS an axis of the errors [n, 2] within a quarter pitch, and the share of those beyond: wrong identities."""
    wrong = np.linalg.norm(off, axis=1) > 0.25 * pitch_px
    rms = float(np.sqrt(np.square(off[~wrong]).mean())) if (~wrong).any() else math.nan
    return {"rms_px": rms, "wrong_share": float(wrong.mean())}


def compare(count: int, seed: int, fps: int, show: Callable[[int], None]) -> dict[str, Any]:
    """Every tracker on the same ``count`` trials: name -> shares with Wilson intervals, RMS px, CPU ms a frame."""
    tallies = {name: Tally() for name in TRACKERS}
    kept: list[SlipTrial] = []
    for done, trial in enumerate(draw_trials(count, seed, fps), 1):
        images = pictures(trial)
        for name, make in TRACKERS.items():
            tallies[name].add(trial, alarm_of(track(trial, images, make, tallies[name])))
        if trial.label == "slip" and len(kept) < MEASURED_N:
            kept.append(trial)
        show(done)
    rows = {name: tallies[name].summary() for name in TRACKERS}
    for noise in NOISES_GREY:
        for name, accuracy in accuracy_at_noise(kept, noise).items():
            rows[name][f"noise_{noise:.0f}"] = accuracy
    return rows
