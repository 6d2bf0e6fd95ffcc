"""Trials as steps of depth: the service's readings of each descent through cameras of many rates.

A stored trial holds the gel at each depth. A camera's frames are taken from it at a drawn rate and phase, with the
tracker's error, and go through the service's own depth reading (:mod:`service.perception.pressing`).
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import track

from service.contract import ContractError, Sensor
from service.contract.model_card import CONDITIONS, MARKER_PITCH, Pressing, Span
from service.perception.pressing import lattice_weights, onset_depth, step_weights
from training.config import DataConfig
from training.data.batches import Batch, mirror_fields
from training.data.dataset import SPLITS, Source, data_sha256, open_source
from training.data.labels import HALF_TURN_SIGNS, MIRROR_SIGNS, class_of
from training.networks.pressing import DECISION_STEPS, LATTICE, STEP_MM, STEPS

FPS = (10.0, 120.0)
WIDEST_SPACING_MM = 0.8
"""Largest travel between frames; beyond it, the motion in between is a guess."""
TRACKING_MM = (0.001, 0.004)
"""Error of a lattice point, RMS per axis: a tracker's 0.04 to 0.08 px, averaged over the markers around it."""
NOTICED_MM = (0.012, 0.03)
"""Motion at which the service detects the onset."""
STATED_ERROR = (2.0, 5.0, 0.1, 0.3, 0.03, 0.0)
"""Largest errors of each condition as stated by a cell: mm of gap and height, shares of the others."""
UNTOLD_SHARE = (0.1, 0.2, 0.3, 0.4, 0.0, 0.0)
"""Share of training decisions without a condition: cells may not know it."""
SCALE_ERROR, ROLL_DEG, LOST_SHARE = 0.03, 2.0, 0.03
"""Errors of a finger's camera: of its calibration, and the share of markers not found."""
CARRIED = 10
"""Rank, from the largest, of the marker motion that detects the onset, as in `carried_px` of the service."""
_TABLE = 2


@dataclass(frozen=True, slots=True)
class Pressed:
    """Views of collided trials; a training trial has several. All arrays share their first axis.

    ``error`` float32 [N, 2] (mm, deg); ``conditions`` float32 [N, 6] as stated, see `CONDITIONS`; ``fields`` float16
    [N, STEPS, 2, rows, columns, 2] (du_mm, dv_mm) of each step, NaN where nothing was visible; ``length`` int64 [N],
    number of steps; ``reach`` float32 [N], the true shear reach in mm, 0 where the dataset does not state it.
    """

    error: NDArray[np.float32]
    conditions: NDArray[np.float32]
    split: NDArray[np.int64]
    objects: NDArray[np.str_]
    groups: NDArray[np.str_]
    fields: NDArray[np.float16]
    length: NDArray[np.int64]
    reach: NDArray[np.float32]
    sha256: str
    sensor: Sensor

    def __len__(self) -> int:
        return len(self.error)

    def of(self, split: str, *, rendered: bool = False) -> NDArray[np.int64]:
        """Indices of a split; none are rendered."""
        return np.flatnonzero((self.split == SPLITS.index(split)) & (not rendered))

    def batch(self, chosen: NDArray[np.int64], rng: np.random.Generator | None) -> Batch:
        """Decisions; with ``rng``, symmetries, cameras' scale, lost markers, and conditions left out."""
        moved = self.fields[chosen].astype(np.float32)
        visible = np.isfinite(moved).all(-1, keepdims=True)
        fields = np.concatenate([np.where(visible, moved, 0.0), visible], -1, dtype=np.float32)
        error, conditions = self.error[chosen].copy(), self.conditions[chosen].copy()
        if rng is not None:
            _vary(fields, error, conditions, rng)
        return Batch(
            fields=torch.from_numpy(np.moveaxis(fields, -1, -3).copy()),
            drawn=None,
            error=torch.from_numpy(error),
            label=torch.from_numpy(class_of(error)),
            geometry=torch.from_numpy(conditions),
            length=torch.from_numpy(self.length[chosen]),
        )

    def pressing(self, strangeness_limit: float | None) -> Pressing:
        """The card's section on how such networks read, with the ranges of the training views."""
        conditions = self.conditions[self.of("train")]
        pitch = self.sensor.marker_pitch_mm
        trained = {MARKER_PITCH: Span(low=0.75 * pitch, high=1.3 * pitch)}
        for name, values in zip(CONDITIONS, conditions.T, strict=True):
            known = values[values > 0]
            if len(known):
                trained[name] = Span(low=float(known.min()), high=float(known.max()))
        return Pressing(
            lattice=LATTICE,
            step_mm=STEP_MM,
            steps_n=DECISION_STEPS,
            least_steps_n=1,
            trained=trained,
            strangeness_limit=strangeness_limit,
        )


def _vary(
    fields: NDArray[np.float32],
    error: NDArray[np.float32],
    conditions: NDArray[np.float32],
    rng: np.random.Generator,
) -> None:
    """Change a batch in place: fields [B, T, 2, rows, columns, 3]."""
    count = len(error)
    mirrored, turned = rng.random((2, count)) < 0.5
    fields[mirrored] = mirror_fields(fields[mirrored])
    fields[turned] = fields[turned][:, :, ::-1]
    error[mirrored] *= MIRROR_SIGNS
    error[turned] *= HALF_TURN_SIGNS
    _miscalibrate(fields, rng)
    lost = rng.random((count, 1, *fields.shape[2:5], 1)) < LOST_SHARE * rng.random((count, 1, 1, 1, 1, 1))
    fields *= ~lost
    conditions[rng.random(conditions.shape) < np.array(UNTOLD_SHARE)] = 0.0


def _miscalibrate(fields: NDArray[np.float32], rng: np.random.Generator) -> None:
    """Scale and turn the motion in each finger's camera within the error of its calibration."""
    one = (len(fields), 1, 2, 1, 1)
    scale, roll = rng.uniform(1.0 - SCALE_ERROR, 1.0 + SCALE_ERROR, one), np.radians(ROLL_DEG) * rng.uniform(-1, 1, one)
    along, across = (scale * np.cos(roll)).astype(np.float32), (scale * np.sin(roll)).astype(np.float32)
    du, dv = fields[..., 0].copy(), fields[..., 1].copy()
    fields[..., 0], fields[..., 1] = along * du - across * dv, across * du + along * dv


def load_pressed(config: DataConfig, source: Source | None = None) -> Pressed:
    """The views of a dataset's collisions, from the cache if it holds them; ContractError as `load_trials`."""
    source = open_source(config.path) if source is None else source
    digest, count = data_sha256(source), min(len(source), config.max_trials)
    path = Path(config.cache) / digest[:16] / f"pressed-{_TABLE}-{count}-{config.views}.npz"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_suffix(".tmp.npz")
        np.savez(temporary, **_table(source, count, config.views))  # type: ignore[arg-type]
        temporary.replace(path)
    with np.load(path) as stored:
        return Pressed(**{name: stored[name] for name in stored.files}, sha256=digest, sensor=source.manifest.sensor)


def _table(source: Source, count: int, views: int) -> dict[str, NDArray[Any]]:
    reader = Reader(source.manifest.sensor)
    rows: dict[str, list[Any]] = {name: [] for name in Pressed.__dataclass_fields__ if name not in ("sha256", "sensor")}
    for index in track(range(count), description="reading descents", transient=True):
        trial = source.trial(index)
        if trial.outcome != "blocked" or trial.onset_frame is None or trial.onset_frame < 1:
            continue
        rng = np.random.default_rng([trial.seed, 0x9E55])
        stored = reader.stored(trial)
        for _ in range(views if trial.split == "train" else 1):
            fields, length, spacing_mm = reader.view(stored, rng)
            conditions = _stated_conditions(stored, spacing_mm, rng)
            values = (
                (trial.x_mm, trial.theta_deg),
                conditions,
                SPLITS.index(trial.split),
                trial.object_name,
                f"{trial.object_name}/{trial.group}",
                fields,
                length,
                stored.conditions[3],
            )
            for name, value in zip(rows, values, strict=True):
                rows[name].append(value)
    if not rows["error"]:
        raise ContractError(f"none of the {count} trials is a collision; expected outcome 'blocked' with an onset")
    kinds = {"split": np.int64, "length": np.int64, "objects": np.str_, "groups": np.str_, "fields": np.float16}
    return {name: np.array(values, kinds.get(name, np.float32)) for name, values in rows.items()}


def _stated_conditions(stored: "Stored", spacing_mm: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """The conditions as a cell would state them, slightly wrong; 0 stays unknown."""
    true, error = (
        np.array([*stored.conditions, spacing_mm]),
        rng.uniform(-1.0, 1.0, len(STATED_ERROR)) * STATED_ERROR,
    )
    stated = np.where(np.arange(len(true)) < 2, true + error, true * np.exp(error))
    return np.asarray(np.where(true > 0, np.maximum(stated, 1e-3), 0.0), np.float32)


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


class Reader:
    """Reads trials of one sensor."""

    def __init__(self, sensor: Sensor) -> None:
        centre = np.array([0.5 * (sensor.width_px - 1), 0.5 * (sensor.height_px - 1)], np.float32)
        rest_mm = (sensor.marker_rest_px().reshape(-1, 2) - centre) * np.float32(sensor.mm_per_px)
        weights = lattice_weights(rest_mm, LATTICE, sensor.marker_pitch_mm)
        self._weights = weights / np.maximum(weights.sum(1, keepdims=True), 1e-6)

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
                getattr(trial, "speed_mm_s", 10.0),
            ),
        )

    def view(self, stored: Stored, rng: np.random.Generator) -> tuple[NDArray[np.float16], int, float]:
        """Steps [STEPS, 2, rows, columns, 2] through a drawn camera, their number, and their spacing in mm."""
        speed_mm_s = stored.conditions[4]
        slowest = max(FPS[0], speed_mm_s / WIDEST_SPACING_MM)
        spacing_mm = speed_mm_s / math.exp(rng.uniform(math.log(slowest), math.log(max(FPS[1], slowest))))
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
