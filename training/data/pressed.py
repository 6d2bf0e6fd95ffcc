"""Trials as steps of depth: arrays of views of many descents, and the batches cut from them."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import track

from service.contract import ContractError, Sensor
from service.contract.model_card import CONDITIONS, MARKER_PITCH, Pressing, Span
from training.config import DataConfig
from training.data.batches import Batch, mirror_fields
from training.data.dataset import SPLITS, Source, data_sha256, open_source, read_table, refuse_split_groups, write_table
from training.data.descents import Reader, Stored
from training.data.labels import HALF_TURN_SIGNS, MIRROR_SIGNS, class_of
from training.networks.pressing import DECISION_STEPS, LATTICE, STEP_MM

STATED_ERROR = (2.0, 5.0, 0.1, 0.3, 0.03, 0.0)
"""Largest errors of each condition as stated by a cell: mm of gap and height, shares of the others."""
UNTOLD_SHARE = (0.1, 0.2, 0.3, 0.4, 0.0, 0.0)
"""Share of training decisions without a condition: cells may not know it."""
SCALE_ERROR, ROLL_DEG, LOST_SHARE = 0.03, 2.0, 0.03
"""Errors of a finger's camera: of its calibration, and the share of markers not found."""
PITCHES = (0.75, 1.3)
"""Marker pitches that a card allows, over its sensor's. They are no range of the data, which has one pitch: so far the
lattice reads the same field alike, whatever the pitch of the markers on it."""
NOT_READ = "sha256", "sensor", "draws"
"""Fields of `Pressed` that are not in the table of a dataset."""
_TRIED_N = 20  # trials whose reading tells whether the code that reads them has changed


@dataclass(frozen=True, slots=True)
class Pressed:
    """Views of collided trials; a training trial has several. All arrays share their first axis.

    ``error`` float32 [N, 2] (mm, deg); ``conditions`` float32 [N, 6] as stated, see `CONDITIONS`; ``fields`` float16
    [N, STEPS, 2, rows, columns, 2] (du_mm, dv_mm) of each step, NaN where nothing was visible; ``length`` int64 [N],
    number of steps; ``reach`` float32 [N], the true shear reach in mm, 0 where the dataset does not state it; ``draws``
    float32 [N, D, 2], errors that a training batch draws from, where the error is not known exactly.
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
    draws: NDArray[np.float32] | None = None

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
            if self.draws is not None:
                error = self.draws[chosen, rng.integers(self.draws.shape[1], size=len(chosen))]
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
        """The card's section on how such networks read, with the ranges of the training views, and `PITCHES`."""
        conditions = self.conditions[self.of("train")]
        least_mm, most_mm = (share * self.sensor.marker_pitch_mm for share in PITCHES)
        trained = {MARKER_PITCH: Span(low=least_mm, high=most_mm)}
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
    name = f"pressed-{reading_sha256(source, count)}-{count}-{config.views}.npz"
    path = Path(config.cache) / digest[:16] / name
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        write_table(path, table_of(source, range(count), config.views))
    return Pressed(**read_table(path), sha256=digest, sensor=source.manifest.sensor)


def reading_sha256(source: Source, count: int) -> str:
    """A hash of the code that reads descents, from its result on the first trials: other readings share no cache."""
    try:
        table = table_of(source, range(min(count, _TRIED_N)), 1)
    except ContractError:  # no collision among them
        return "none"
    return hashlib.sha256(table["fields"].tobytes() + table["conditions"].tobytes()).hexdigest()[:12]


def table_of(source: Source, chosen: Sequence[int], views: int, fps: float | None = None) -> dict[str, Any]:
    """Fields of `Pressed` of the chosen trials; with ``fps``, all cameras have that rate.

    Raises ContractError if none collided, if a trial is not finite, or if a group is in two splits.
    """
    reader = Reader(source.manifest.sensor)
    rows: dict[str, list[Any]] = {name: [] for name in Pressed.__dataclass_fields__ if name not in NOT_READ}
    for index in track(chosen, description="reading descents", transient=True):
        trial = source.trial(index)
        if trial.outcome != "blocked" or trial.onset_frame is None or trial.onset_frame < 1:
            continue
        for name in ("gel", "depth_mm"):
            if not np.isfinite(getattr(trial, name)).all():
                raise ContractError(f"trial {index}: {name} is not finite")
        rng = np.random.default_rng([trial.seed, 0x9E55])
        stored = reader.stored(trial)
        for _ in range(views if trial.split == "train" else 1):
            fields, length, spacing_mm = reader.view(stored, rng, fps)
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
        raise ContractError(
            f"none of the {len(chosen)} trials is a collision; expected outcome 'blocked' with an onset"
        )
    kinds = {"split": np.int64, "length": np.int64, "objects": np.str_, "groups": np.str_, "fields": np.float16}
    table: dict[str, Any] = {name: np.array(values, kinds.get(name, np.float32)) for name, values in rows.items()}
    refuse_split_groups(table)
    return table


def _stated_conditions(stored: Stored, spacing_mm: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """The conditions as a cell would state them, slightly wrong; 0 stays unknown."""
    true, error = (
        np.array([*stored.conditions, spacing_mm]),
        rng.uniform(-1.0, 1.0, len(STATED_ERROR)) * STATED_ERROR,
    )
    stated = np.where(np.arange(len(true)) < 2, true + error, true * np.exp(error))
    return np.asarray(np.where(true > 0, np.maximum(stated, 1e-3), 0.0), np.float32)
