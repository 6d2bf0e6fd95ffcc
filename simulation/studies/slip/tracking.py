"""Error of the tracker on simulated descents: displacement RMS at 2 and 6 grey levels of noise."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from service.contract import Sensor
from service.perception.markers.field import MarkerField
from simulation.studies.slip.detection import pictures, track
from simulation.studies.slip.trials import SlipTrial, draw_trials

NOISES_GREY = (2.0, 6.0)
MEASURED_N = 16  # slip trials whose displacements are compared with the truth at each noise


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
    """Row and column [rows, cols] of the gel's node for each node of a tracker's grid, placed where most of them rest.

    Not the nearest: a firm grasp bulges the gel by more than half a pitch before the first frame.
    """
    row, column = np.mgrid[0 : field.valid.shape[0], 0 : field.valid.shape[1]]
    away = (field.rest_px - sensor.marker_rest_px()[0, 0]) / sensor.marker_pitch_px - np.stack([column, row], -1)
    most = np.rint(np.median(away.reshape(-1, 2), axis=0)).astype(int)
    last = sensor.marker_rows - 1, sensor.marker_columns - 1
    return np.clip(row + most[1], 0, last[0]), np.clip(column + most[0], 0, last[1])


def accuracy_at_noise(trials: Sequence[SlipTrial], noise: float) -> dict[str, float]:
    """At a camera noise in grey levels: ``rms_px`` per axis of the errors within a quarter pitch.

    ``wrong_share`` is the share of larger errors, wrong identities; ``tracked_share`` the share of the markers whose
    place the tracker states.
    """
    errors: list[NDArray[np.float64]] = []
    tracked: list[float] = []
    for trial in trials:
        noisy = replace(trial, scene=trial.scene.varied({"camera.noise_grey": noise}))
        fields = track(noisy, pictures(noisy))
        errors.append(displacement_error_px(noisy, fields))
        markers_n = trial.gel[0, 0, ..., 0].size
        tracked += [float(field.valid.sum()) / markers_n for sequence in fields for field in sequence[1:]]
    off = np.concatenate(errors)
    wrong = np.linalg.norm(off, axis=1) > 0.25 * trials[0].scene.sensor.marker_pitch_px
    rms = float(np.sqrt(np.square(off[~wrong]).mean())) if (~wrong).any() else math.nan
    return {"rms_px": rms, "wrong_share": float(wrong.mean()), "tracked_share": float(np.mean(tracked))}


def measure(seed: int, fps: int) -> dict[str, dict[str, float]]:
    """Both noises on the same slip trials, and the lower one behind a used sensor."""
    trials = [trial for trial in draw_trials(8 * MEASURED_N, seed, fps) if trial.label == "slip"][:MEASURED_N]
    used = [replace(trial, scene=trial.scene.varied({"camera.used_share": 1.0})) for trial in trials]
    new = {f"noise_{noise:.0f}": accuracy_at_noise(trials, noise) for noise in NOISES_GREY}
    return {**new, "used_sensor": accuracy_at_noise(used, NOISES_GREY[0])}
