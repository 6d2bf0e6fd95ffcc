"""A trial: one poke that collided; how it is stored, checked and turned into frames."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from service.contract import Sensor
from simulation.data.manifest import DatasetError
from simulation.optics.appearance import Appearance

Split = Literal["train", "validation", "test"]
SPLITS: tuple[Split, ...] = get_args(Split)
FRAMES, FINGER_COUNT = 30, 2
VALIDATION_SHARE = 0.15


@dataclass(frozen=True, slots=True)
class Trial:
    """One poke that collided, as logged.

    ``x_mm``/``theta_deg``: position error before the descent (ground truth). ``group``: re-fixture group, the unit of
    the split. ``grasp_height_mm``: TCP above the object's bottom. ``gel`` float16 [30, 2, rows, columns, 3]: (du_mm,
    dv_mm, pressure N/mm2) per frame and finger (left, right). ``onset_frame``: first frame that shows motion of the
    object; a decision uses 8 frames from there. ``drawn``: for a drawn cell, all drawn parameters as JSON by dotted
    key. ``speed_mm_s``, ``grip_n`` and ``shear_reach_mm`` are then stated, too, and frames are equal steps of depth;
    otherwise they are 0. ``wrench`` float32 [30, 6] (N, N mm) at the TCP; ``depth_mm`` float32 [30]; ``in_hand``
    float32 [30, 6] (mm, rad).
    """

    x_mm: float
    theta_deg: float
    object_name: str
    gap_width_mm: float
    grasp_height_mm: float
    group: int
    poke: int
    seed: int
    scene_sha256: str
    onset_frame: int
    true_slip_frame: int
    stop_frame: int
    outcome: str
    split: Split
    appearances: tuple[Appearance, Appearance]
    gel: NDArray[np.float16]
    depth_mm: NDArray[np.float32]
    wrench: NDArray[np.float32]
    in_hand: NDArray[np.float32]
    drawn: str = ""
    speed_mm_s: float = 0.0
    grip_n: float = 0.0
    shear_reach_mm: float = 0.0

    @property
    def sensor(self) -> Sensor:
        """The profile of both fingers."""
        return self.appearances[0].sensor

    def check(self) -> None:
        """Raise DatasetError naming the first invalid label or array."""
        for name in LABELS:
            if not np.isfinite(getattr(self, name)):
                raise DatasetError(f"trial label {name} is {getattr(self, name)}, expected a finite number")
        if self.split not in SPLITS:
            raise DatasetError(f"trial split {self.split!r}, expected one of {', '.join(SPLITS)}")
        for name, (shape, _) in arrays(self.sensor).items():
            array = getattr(self, name)
            if array.shape != shape:
                raise DatasetError(f"trial {name} has shape {list(array.shape)}, expected {list(shape)}")
            if not np.isfinite(array).all():
                raise DatasetError(f"trial {name} holds a number that is not finite")
        if not 0 <= self.onset_frame <= FRAMES - 8:
            raise DatasetError(f"trial onset_frame {self.onset_frame}, expected 0..{FRAMES - 8} (8 frames follow it)")


def split_of(group: int, *, held_out: bool) -> Split:
    """Whole re-fixture groups go to one side; groups from held-out ranges are the test set."""
    if held_out:
        return "test"
    share = np.random.Generator(np.random.PCG64([0x5B117, group])).random()
    return "validation" if share < VALIDATION_SHARE else "train"


LABELS = ("x_mm", "theta_deg", "gap_width_mm", "grasp_height_mm")
SCALARS = (
    "x_mm",
    "theta_deg",
    "object_name",
    "gap_width_mm",
    "grasp_height_mm",
    "group",
    "poke",
    "seed",
    "scene_sha256",
    "onset_frame",
    "true_slip_frame",
    "stop_frame",
    "outcome",
    "split",
)


DRAWN = {"drawn": "", "speed_mm_s": 0.0, "grip_n": 0.0, "shear_reach_mm": 0.0}
"""Columns of drawn cells, and their values for other cells."""


def arrays(sensor: Sensor) -> dict[str, tuple[tuple[int, ...], Any]]:
    """Shape and dtype of each array of a trial."""
    return {
        "gel": ((FRAMES, FINGER_COUNT, sensor.marker_rows, sensor.marker_columns, 3), np.float16),
        "depth_mm": ((FRAMES,), np.float32),
        "wrench": ((FRAMES, 6), np.float32),
        "in_hand": ((FRAMES, 6), np.float32),
    }


def parquet_schema(sensor: Sensor, *, drawn: bool = False) -> Any:
    """The Arrow schema of a shard: scalars, optics as JSON, arrays as fixed-size little-endian bytes.

    drawn: with the columns of drawn cells.
    """
    import pyarrow as pa

    kinds = dict.fromkeys(LABELS, pa.float64())
    kinds |= dict.fromkeys(("object_name", "outcome", "split", "scene_sha256"), pa.string())
    fields = [pa.field(name, kinds.get(name, pa.int64()), nullable=False) for name in SCALARS]
    fields.append(pa.field("appearances", pa.string(), nullable=False))
    sizes = {name: int(np.prod(shape)) * np.dtype(kind).itemsize for name, (shape, kind) in arrays(sensor).items()}
    fields += [pa.field(name, pa.binary(size), nullable=False) for name, size in sizes.items()]
    if drawn:
        fields.append(pa.field("drawn", pa.string(), nullable=False))
        fields += [pa.field(name, pa.float64(), nullable=False) for name in list(DRAWN)[1:]]
    return pa.schema(fields)


def stated(trial: Trial) -> dict[str, Any]:
    """A row of a shard without its arrays."""
    names = (*SCALARS, *DRAWN) if trial.drawn else SCALARS
    row: dict[str, Any] = {name: getattr(trial, name) for name in names}
    return row | {"appearances": json.dumps([look.as_dict() for look in trial.appearances], sort_keys=True)}


def to_row(trial: Trial) -> dict[str, Any]:
    """The trial as one row of a shard."""
    row = stated(trial)
    for name, (_, kind) in arrays(trial.sensor).items():
        row[name] = np.ascontiguousarray(getattr(trial, name), kind).tobytes()
    return row


def from_row(row: dict[str, Any], sensor: Sensor) -> Trial:
    """Inverse of :func:`to_row`; arrays are read-only views of the row's bytes."""
    left, right = (Appearance.from_dict(look, sensor) for look in json.loads(row["appearances"]))
    values: dict[str, Any] = {name: row[name] for name in SCALARS}
    values |= {name: np.frombuffer(row[name], kind).reshape(shape) for name, (shape, kind) in arrays(sensor).items()}
    values |= {name: row.get(name, missing) for name, missing in DRAWN.items()}
    return Trial(appearances=(left, right), **values)


def frame_seed(trial_seed: int, frame: int, finger: int) -> int:
    """The noise seed of one frame of one trial."""
    return int(np.random.SeedSequence([trial_seed, frame, finger]).generate_state(1, np.uint64)[0])


def render_frames(trial: Trial, renderer_of: Callable[[Appearance], Any], start: int, count: int) -> NDArray[np.uint8]:
    """Uint8 [count, 2, H, W, 3] of ``trial`` from frame ``start``; DatasetError outside 0..30."""
    if not 0 <= start <= start + count <= FRAMES:
        raise DatasetError(f"frames {start}..{start + count - 1} asked for, a trial has 0..{FRAMES - 1}")
    out = np.empty((count, FINGER_COUNT, *trial.sensor.rectified.shape), np.uint8)
    for finger, look in enumerate(trial.appearances):
        renderer = renderer_of(look)
        for k in range(count):
            frame = start + k
            before = trial.gel[max(0, frame - 1), finger]
            raw = renderer.raw(trial.gel[frame, finger], frame_seed(trial.seed, frame, finger), before)
            out[k, finger] = renderer.rectify(raw)
    return out
