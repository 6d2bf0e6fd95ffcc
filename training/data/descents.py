"""A stored descent through a camera: the service's readings of it, step of depth by step of depth.

A stored trial holds the gel at each depth. A camera's frames are taken from it at a drawn rate and phase, with the
tracker's error, and go through the service's own depth reading (:mod:`service.perception.pressing`).
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.contract import Sensor
from service.perception.pressing import VISIBLE_SHARE, lattice_weights, onset_depth, step_weights
from training.networks.pressing import LATTICE, STEP_MM, STEPS

FPS = (10.0, 120.0)
WIDEST_SPACING_MM = 0.8
"""Largest travel between frames; beyond it, the motion in between is a guess."""
TRACKING_MM = (0.001, 0.004)
"""Error of a lattice point, RMS per axis: a tracker's 0.04 to 0.08 px, averaged over the markers around it."""
NOTICED_MM = (0.012, 0.03)
"""Motion at which the service detects the onset."""
SCENE_MM_S = 10.0
"""Speed of a scene that states none."""
CARRIED = 10
"""Rank, from the largest, of the marker motion that detects the onset, as in `carried_px` of the service."""


@dataclass(frozen=True, slots=True)
class Stored:
    """One trial on the lattice, n moments.

    ``depths_mm`` [n], rising, 0 at its onset frame; ``fields`` [n, 2 * points * 2] in mm since the first of them;
    ``carried_mm`` [n], the motion that detects an onset; ``conditions``: true, without the spacing of frames.
    """

    depths_mm: NDArray[np.float64]
    fields: NDArray[np.float64]
    carried_mm: NDArray[np.float64]
    conditions: tuple[float, ...]


def speed_of(trial: Any) -> float:
    """Speed of a trial's descent, mm/s: that of the scenes where the trial states none, or 0."""
    return float(getattr(trial, "speed_mm_s", 0.0)) or SCENE_MM_S


class Reader:
    """Reads trials of one sensor."""

    def __init__(self, sensor: Sensor) -> None:
        centre = np.array([0.5 * (sensor.width_px - 1), 0.5 * (sensor.height_px - 1)], np.float32)
        rest_mm = (sensor.marker_rest_px().reshape(-1, 2) - centre) * np.float32(sensor.mm_per_px)
        weights = lattice_weights(rest_mm, LATTICE, sensor.marker_pitch_mm)
        total = weights.sum(1, keepdims=True)
        self._hidden = total[:, 0] <= VISIBLE_SHARE  # too few markers around these points, as in the service
        self._weights = np.where(self._hidden[:, None], 0.0, weights / np.maximum(total, 1e-6)).astype(np.float32)

    def stored(self, trial: Any) -> Stored:
        """The stored part of a trial, from the frame before its onset to the last frame of the arm's descent."""
        begin, depths_mm = int(trial.onset_frame) - 1, np.asarray(trial.depth_mm, np.float64)
        end = begin + 1 + int(np.argmax(np.append(np.diff(depths_mm[begin:]) <= 0.0, True)))
        gel = np.asarray(trial.gel[begin:end, ..., :2], np.float32)
        moved = (gel - gel[:1]).reshape(end - begin, 2, -1, 2)
        fields = np.matmul(self._weights, moved).reshape(end - begin, -1)
        lengths = np.sort(np.hypot(moved[..., 0], moved[..., 1]).reshape(end - begin, -1), 1)
        return Stored(
            depths_mm[begin:end] - depths_mm[begin + 1],
            fields.astype(np.float64),
            lengths[:, -CARRIED].astype(np.float64),
            (
                trial.gap_width_mm,
                trial.grasp_height_mm,
                getattr(trial, "grip_n", 0.0),
                getattr(trial, "shear_reach_mm", 0.0),
                speed_of(trial),
            ),
        )

    def view(
        self, stored: Stored, rng: np.random.Generator, fps: float | None = None
    ) -> tuple[NDArray[np.float16], int, float]:
        """Steps [STEPS, 2, rows, columns, 2] through a camera, their number, and the spacing of its frames in mm.

        The camera is drawn; ``fps`` is its rate if given.
        """
        speed_mm_s = stored.conditions[4]
        slowest = max(FPS[0], speed_mm_s / WIDEST_SPACING_MM)
        drawn = math.exp(rng.uniform(math.log(slowest), math.log(max(FPS[1], slowest))))
        spacing_mm = speed_mm_s / (fps or drawn)
        last_mm = float(stored.depths_mm[-1])
        frames_mm = np.arange(rng.random() - 2.0, last_mm / spacing_mm + 1.0) * spacing_mm
        frames_mm = frames_mm[frames_mm <= last_mm]
        if len(frames_mm) < 4:
            frames_mm = np.linspace(-spacing_mm, last_mm, 4)
        taken = _between(stored.depths_mm, frames_mm)
        noise_mm = rng.uniform(*TRACKING_MM)
        first, begin_mm = self._onset(stored, frames_mm, taken, noise_mm, rng)
        frames_mm = np.concatenate([[begin_mm], frames_mm[first:]])
        taken = np.concatenate([np.zeros((1, taken.shape[1])), taken[first:]])
        return *self._steps(stored, frames_mm, taken, noise_mm, rng), spacing_mm

    def _onset(
        self,
        stored: Stored,
        frames_mm: NDArray[np.float64],
        taken: NDArray[np.float64],
        noise_mm: float,
        rng: np.random.Generator,
    ) -> tuple[int, float]:
        """The first frame that shows motion, and the depth at which the service takes it to have begun."""
        noticed = taken @ stored.carried_mm > rng.uniform(*NOTICED_MM)
        first = min(max(int(np.argmax(noticed)) if noticed.any() else len(taken), 1), len(taken) - 2)
        moved = np.zeros((first + 2, stored.fields.shape[1]), np.float32)
        clean = taken[first : first + 2] @ stored.fields
        moved[first:] = clean + rng.normal(0.0, noise_mm, clean.shape)
        return first, onset_depth(frames_mm[: first + 2], moved, first)

    def _steps(
        self,
        stored: Stored,
        frames_mm: NDArray[np.float64],
        taken: NDArray[np.float64],
        noise_mm: float,
        rng: np.random.Generator,
    ) -> tuple[NDArray[np.float16], int]:
        ends_mm = frames_mm[0] + STEP_MM * np.arange(1, STEPS + 1)
        length = max(1, int((ends_mm <= frames_mm[-1]).sum()))
        weights = np.stack([step_weights(frames_mm, end - STEP_MM, end) for end in ends_mm[:length]])
        quiet = np.sqrt((weights**2).sum(1, keepdims=True))
        steps = weights @ taken @ stored.fields + noise_mm * (
            quiet * rng.normal(size=(length, stored.fields.shape[1]))
            + 0.5 * rng.normal(size=(1, stored.fields.shape[1]))  # the reference is a mean of a few frames
        )
        out = np.zeros((STEPS, 2, LATTICE.rows, LATTICE.columns, 2), np.float16)
        out[:length] = steps.reshape(length, *out.shape[1:])
        out.reshape(STEPS, 2, -1, 2)[:, :, self._hidden] = np.nan
        return out, length


def _between(depths_mm: NDArray[np.float64], frames_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """[frames, stored]: each frame as a mean of the two stored moments around it."""
    upper = np.clip(np.searchsorted(depths_mm, frames_mm), 1, len(depths_mm) - 1)
    share = np.clip((frames_mm - depths_mm[upper - 1]) / (depths_mm[upper] - depths_mm[upper - 1]), 0.0, 1.0)
    taken = np.zeros((len(frames_mm), len(depths_mm)))
    lines = np.arange(len(frames_mm))
    taken[lines, upper - 1] += 1.0 - share
    taken[lines, upper] += share
    return taken
