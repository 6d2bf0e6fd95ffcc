"""Trials as arrays: labels and marker fields of all of them, pooled pictures of some, cached on disk once.

The only module that touches the simulator, and only its readers of datasets.
"""

import hashlib
import json
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from service.contract import ContractError, Sensor
from service.durable import replacing
from service.perception.markers.sequence import track_pairs
from training.config import JITTER, WINDOW, DataConfig
from training.networks.preprocessing import pool_frames
from training.networks.settings import FRAMES_PER_DECISION

SPLITS = ("train", "validation", "test")
Reads = Literal["pictures", "markers"]
_TABLE = 4  # format of the cached table
_KEPT: dict[Reads, str] = {"pictures": "pooled-2", "markers": "tracked-1"}  # folders of inputs from pictures


class Source(Protocol):
    """The interface used of ``simulation.data.dataset.Dataset``."""

    manifest: Any

    def __len__(self) -> int: ...

    def trial(self, index: int) -> Any:
        """One trial: labels, provenance and gel states."""

    def frames(self, index: int, start: int, count: int) -> NDArray[np.uint8]:
        """Rendered frames [count, 2, H, W, 3]."""


@dataclass(frozen=True, slots=True)
class Trials:
    """Collided trials. All arrays share their first axis except ``drawn``, indexed through ``picture``.

    ``error`` float32 [N, 2] (mm, deg); ``geometry`` float32 [N, 2], gap width and grasp height in mm, 0 if unknown;
    ``fields`` float16 [N, WINDOW, 2, rows, columns, 3] (du_mm, dv_mm, N/mm2) from one frame before the onset; ``drawn``
    the network's input from the pictures: block sums uint16 [M, WINDOW, 2, 2, h, w], or markers tracked in them float32
    [M, WINDOW, 2, rows, columns, 3]; ``picture`` int64 [N] row or -1.
    """

    error: NDArray[np.float32]
    geometry: NDArray[np.float32]
    split: NDArray[np.int64]
    objects: NDArray[np.str_]
    groups: NDArray[np.str_]
    fields: NDArray[np.float16]
    picture: NDArray[np.int64]
    drawn: NDArray[Any]
    sha256: str
    sensor: Sensor

    def __len__(self) -> int:
        return len(self.error)

    def of(self, split: str, *, rendered: bool = False) -> NDArray[np.int64]:
        """Indices of a split; with ``rendered``, only of its rendered trials."""
        chosen = self.split == SPLITS.index(split)
        return np.flatnonzero(chosen & (self.picture >= 0) if rendered else chosen)


def open_source(path: str) -> Source:
    """Open a collected dataset, its shards or its LeRobot export; ContractError naming the path if there is none."""
    from simulation.data.dataset import Dataset
    from simulation.data.lerobot import INFO, Exported

    try:
        source: Source = Exported(Path(path)) if (Path(path) / INFO).exists() else Dataset(path)
    except (OSError, ValueError) as error:
        raise ContractError(f"cannot read the dataset {path}: {error}") from error
    return source


def data_sha256(source: Source) -> str:
    """Hash of the dataset's manifest, which names every shard and its own hash."""
    digest: str = source.manifest.sha256()
    return digest


def _key(trial: Any) -> str:
    """Hash of everything that determines a trial's pictures."""
    stated = (trial.scene_sha256, trial.seed, trial.group, trial.poke, trial.onset_frame, trial.x_mm, trial.theta_deg)
    return hashlib.sha256(json.dumps(stated).encode() + trial.gel.tobytes()).hexdigest()[:24]


def reader_sha256(source: Source, reads: Reads) -> str:
    """A hash of the code that draws and reads pictures, from its result on the first trial's decision.

    Pictures drawn or tracked differently thus never share a cache, without any version number. The decision's frames
    show everything that is drawn: before its onset no marker has moved.
    """
    onset = min(max(int(source.trial(0).onset_frame or 0), 0), len(source.trial(0).gel) - FRAMES_PER_DECISION)
    frames = source.frames(0, onset, FRAMES_PER_DECISION)
    kept = shown(frames, source.manifest.sensor, reads) if reads == "markers" else frames
    return hashlib.sha256(np.ascontiguousarray(kept).tobytes()).hexdigest()[:12]


def shown(frames: NDArray[np.uint8], sensor: Sensor, reads: Reads) -> NDArray[Any]:
    """A network's input from frames uint8 [n, 2, H, W, 3]: the markers tracked in them, or block sums."""
    if reads == "markers":
        return track_pairs(frames, sensor.markers, sensor.fps)
    return pool_frames(frames, sensor)


def load_trials(config: DataConfig, source: Source | None = None, reads: Reads = "pictures") -> Trials:
    """Read labels and fields, and draw the configured pictures, from the cache where it holds them.

    Raises ContractError on non-finite labels, on trials without their window or of drawn cells, and on groups spread
    over splits.
    """
    source = open_source(config.path) if source is None else source
    digest = data_sha256(source)
    folder = Path(config.cache) / digest[:16]
    table = load_table(source, folder, min(len(source), config.max_trials))
    picture, drawn = _load_pictures(source, table, config, reads)
    return Trials(
        error=table["error"],
        geometry=table["geometry"],
        split=table["split"],
        objects=table["objects"],
        groups=table["groups"],
        fields=table["fields"],
        picture=picture,
        drawn=drawn,
        sha256=digest,
        sensor=source.manifest.sensor,
    )


def _window_start(trial: Any, index: int) -> int:
    start = int(trial.onset_frame) - JITTER
    length = len(trial.gel)
    if start < 0 or start + WINDOW > length:
        start = min(max(start, 0), length - WINDOW)
        if abs(start - (int(trial.onset_frame) - JITTER)) > JITTER:
            raise ContractError(
                f"trial {index}: onset at frame {trial.onset_frame} of {length}, expected {FRAMES_PER_DECISION} from it"
            )
    return start


def load_table(source: Source, folder: Path, count: int) -> dict[str, NDArray[Any]]:
    """Labels, windows and fields of the first ``count`` trials that collided, cached in ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"table-{_TABLE}-{count}.npz"
    if path.exists():
        return read_table(path)
    rows: dict[str, list[Any]] = {
        name: [] for name in ("key", "index", "start", "error", "geometry", "split", "objects", "groups")
    }
    fields = []
    for index in track(range(count), description="reading trials", transient=True):
        trial = source.trial(index)
        if trial.outcome != "blocked" or trial.onset_frame is None or trial.onset_frame < 0:
            continue
        if getattr(trial, "drawn", ""):
            what = "the frames of a drawn cell are equal steps of depth, not of time"
            raise ContractError(f"trial {index}: {what}; expected network.kind = 'pressing', or named objects")
        start = _window_start(trial, index)
        rows["key"].append(_key(trial))
        rows["index"].append(index)
        rows["start"].append(start)
        rows["error"].append((trial.x_mm, trial.theta_deg))
        rows["geometry"].append((trial.gap_width_mm, trial.grasp_height_mm))
        rows["split"].append(SPLITS.index(trial.split))
        rows["objects"].append(trial.object_name)
        rows["groups"].append(f"{trial.object_name}/{trial.group}")
        fields.append(np.asarray(trial.gel[start : start + WINDOW], np.float16))
    if not fields:
        raise ContractError(f"none of the {count} trials is a collision; expected outcome 'blocked' with an onset")
    table = _as_arrays(rows) | {"fields": np.stack(fields)}
    _check(table)
    write_table(path, table)
    return table


def _as_arrays(rows: dict[str, list[Any]]) -> dict[str, NDArray[Any]]:
    kinds = {"error": np.float32, "geometry": np.float32, "index": np.int64, "start": np.int64, "split": np.int64}
    return {name: np.array(values, kinds.get(name, np.str_)) for name, values in rows.items()}


def _check(table: dict[str, NDArray[Any]]) -> None:
    for name in ("error", "geometry", "fields"):
        if not np.isfinite(table[name]).all():
            bad = int(np.flatnonzero(~np.isfinite(table[name].reshape(len(table[name]), -1)).all(1))[0])
            raise ContractError(f"trial {int(table['index'][bad])}: {name} is not finite")
    refuse_split_groups(table)


def refuse_split_groups(table: dict[str, NDArray[Any]]) -> None:
    """Raise ContractError if a re-fixture group is in two splits: figures would be on trials like those trained on."""
    homes: dict[str, int] = {}
    for group, split in zip(table["groups"].tolist(), table["split"].tolist(), strict=True):
        if homes.setdefault(group, split) != split:
            raise ContractError(f"re-fixture group {group} is in {SPLITS[split]} and {SPLITS[homes[group]]}")


def refuse_empty_splits(split: NDArray[np.int64]) -> None:
    """Raise ContractError unless there are collisions to train on and to validate with."""
    for name in ("train", "validation"):
        if not (split == SPLITS.index(name)).any():
            raise ContractError(f"the dataset has no collisions in its {name} split; collect more re-fixtures")


def read_table(path: Path) -> dict[str, NDArray[Any]]:
    """A table that `write_table` wrote; ContractError if it is damaged."""
    with reading(path) as file, np.load(file) as stored:
        return {name: stored[name] for name in stored.files}


@contextmanager
def reading(path: Path) -> Iterator[BinaryIO]:
    """A file of the cache; a damaged one is a ContractError."""
    try:
        with path.open("rb") as file:
            yield file
    except (ValueError, EOFError, zipfile.BadZipFile) as error:
        raise ContractError(f"{path} of the cache is damaged; remove it, it is made again") from error


def write_table(path: Path, table: dict[str, NDArray[Any]]) -> None:
    """Write arrays as `read_table` reads them."""
    with _whole(path) as file:
        np.savez(file, **table)  # type: ignore[arg-type]


@contextmanager
def _whole(path: Path) -> Iterator[BinaryIO]:
    """A file to write whole or not at all, also where another process writes it; ContractError on a full disk."""
    try:
        with replacing(path) as file:
            yield file
    except OSError as error:
        raise ContractError(f"{path} cannot be written, is the disk full? {error.strerror}") from error


def _load_pictures(
    source: Source, table: dict[str, NDArray[Any]], config: DataConfig, reads: Reads
) -> tuple[NDArray[np.int64], NDArray[Any]]:
    """The pictures of a fixed choice of trials, cached in one file each: a kill or a growing dataset loses none."""
    wanted = _choose(table, config)
    drawer = reader_sha256(source, reads) if len(wanted) else "none"
    folder = Path(config.cache) / f"{_KEPT[reads]}-{drawer}"
    folder.mkdir(parents=True, exist_ok=True)
    kept = []
    for trial in track(wanted, description="drawing pictures", disable=not len(wanted), transient=True):
        path = folder / f"{table['key'][trial]}.npy"
        if not path.exists():
            frames = source.frames(int(table["index"][trial]), int(table["start"][trial]), WINDOW)
            with _whole(path) as file:
                np.save(file, shown(frames, source.manifest.sensor, reads))
        with reading(path) as file:
            kept.append(np.load(file))
    picture = np.full(len(table["split"]), -1, np.int64)
    picture[wanted] = np.arange(len(wanted))
    return picture, np.stack(kept) if kept else np.zeros((0, WINDOW, 2), np.uint16)


def _choose(table: dict[str, NDArray[Any]], config: DataConfig) -> NDArray[np.int64]:
    """The first trials of each split in the order of their keys: a random choice that a growing dataset keeps."""
    counts = (config.rendered_training, config.rendered_validation, config.rendered_test)
    order = np.argsort(table["key"])
    return np.concatenate([order[table["split"][order] == code][:count] for code, count in enumerate(counts)])
