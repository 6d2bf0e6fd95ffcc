"""Trials as arrays: labels and marker fields of all of them, pooled pictures of some, cached on disk once.

The only module that touches the simulator, and only its dataset reader.
"""

import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from service.contract import ContractError
from training.config import FRAMES_PER_DECISION, JITTER, WINDOW, DataConfig
from training.networks.preprocessing import CHANNELS, COLS, ROWS, pool_frames

SPLITS = ("train", "validation", "test")
FIELD_SHAPE = (2, 20, 21, 3)
_FORMAT = 1


class Source(Protocol):
    """What is used of ``simulation.dataset.Dataset``."""

    manifest: Any

    def __len__(self) -> int: ...

    def trial(self, index: int) -> Any:
        """One trial: labels, provenance and gel states."""
        ...

    def frames(self, index: int, start: int, count: int) -> NDArray[np.uint8]:
        """Rendered frames [count, 2, 320, 327, 3]."""
        ...


@dataclass(frozen=True, slots=True)
class Trials:
    """Collided trials. All arrays share their first axis except ``pooled``, found through ``picture``.

    ``error`` float32 [N, 2] (mm, deg); ``fields`` float16 [N, WINDOW, 2, 20, 21, 3] (du_mm, dv_mm, N/mm2) from one
    frame before the onset; ``pooled`` uint16 [M, WINDOW, 2, 2, 64, 65] block sums; ``picture`` int64 [N] row or -1.
    """

    error: NDArray[np.float32]
    gap_width_mm: NDArray[np.float32]
    split: NDArray[np.int64]
    objects: NDArray[np.str_]
    groups: NDArray[np.str_]
    fields: NDArray[np.float16]
    picture: NDArray[np.int64]
    pooled: NDArray[np.uint16]
    sha256: str

    def __len__(self) -> int:
        return len(self.error)

    def of(self, split: str, *, rendered: bool = False) -> NDArray[np.int64]:
        """Indices of a split, of its rendered trials only if asked."""
        chosen = self.split == SPLITS.index(split)
        return np.flatnonzero(chosen & (self.picture >= 0) if rendered else chosen)


def open_source(path: str) -> Source:
    """Open a collected dataset; raise ContractError naming the path if there is none."""
    from simulation.dataset import Dataset

    try:
        source: Source = Dataset(path)
    except (OSError, ValueError) as error:
        raise ContractError(f"cannot read the dataset {path}: {error}") from error
    return source


def data_sha256(source: Source) -> str:
    """Hash of the dataset's manifest, which names every shard and its own hash."""
    manifest = source.manifest
    plain = manifest.model_dump(mode="json") if hasattr(manifest, "model_dump") else manifest
    return hashlib.sha256(json.dumps(plain, sort_keys=True, default=str).encode()).hexdigest()


def load_trials(config: DataConfig, seed: int, source: Source | None = None) -> Trials:
    """Read labels and fields, and draw the pictures asked for, from the cache where it already holds them.

    Raises ContractError on non-finite labels, on trials without their window, and on groups spread over splits.
    """
    source = open_source(config.path) if source is None else source
    digest = data_sha256(source)
    folder = Path(config.cache) / digest[:16]
    folder.mkdir(parents=True, exist_ok=True)
    table = _load_table(source, folder, min(len(source), config.max_trials))
    picture, pooled = _load_pictures(source, folder, table, config, seed)
    return Trials(
        error=table["error"],
        gap_width_mm=table["gap"],
        split=table["split"],
        objects=table["objects"],
        groups=table["groups"],
        fields=table["fields"],
        picture=picture,
        pooled=pooled,
        sha256=digest,
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


def _load_table(source: Source, folder: Path, count: int) -> dict[str, NDArray[Any]]:
    path = folder / f"table-{_FORMAT}-{count}.npz"
    if path.exists():
        with np.load(path) as stored:
            return {name: stored[name] for name in stored.files}
    rows: dict[str, list[Any]] = {name: [] for name in ("index", "start", "error", "gap", "split", "objects", "groups")}
    fields = []
    for index in track(range(count), description="reading trials", transient=True):
        trial = source.trial(index)
        if trial.outcome != "blocked" or trial.onset_frame is None or trial.onset_frame < 0:
            continue
        start = _window_start(trial, index)
        rows["index"].append(index)
        rows["start"].append(start)
        rows["error"].append((trial.x_mm, trial.theta_deg))
        rows["gap"].append(trial.gap_width_mm)
        rows["split"].append(SPLITS.index(trial.split))
        rows["objects"].append(trial.object_name)
        rows["groups"].append(str(trial.group))
        fields.append(np.asarray(trial.gel[start : start + WINDOW], np.float16))
    if not fields:
        raise ContractError(f"none of the {count} trials is a collision; expected outcome 'blocked' with an onset")
    table = _as_arrays(rows, np.stack(fields))
    _check(table)
    _write(path, table)
    return table


def _as_arrays(rows: dict[str, list[Any]], fields: NDArray[np.float16]) -> dict[str, NDArray[Any]]:
    kinds = {"error": np.float32, "gap": np.float32, "index": np.int64, "start": np.int64, "split": np.int64}
    table: dict[str, NDArray[Any]] = {name: np.array(values, kinds.get(name, np.str_)) for name, values in rows.items()}
    return table | {"fields": fields}


def _check(table: dict[str, NDArray[Any]]) -> None:
    for name in ("error", "gap", "fields"):
        if not np.isfinite(table[name]).all():
            bad = int(np.flatnonzero(~np.isfinite(table[name].reshape(len(table[name]), -1)).all(1))[0])
            raise ContractError(f"trial {int(table['index'][bad])}: {name} is not finite")
    homes: dict[str, int] = {}
    for group, split in zip(table["groups"].tolist(), table["split"].tolist(), strict=True):
        if homes.setdefault(group, split) != split:
            raise ContractError(f"re-fixture group {group} is in {SPLITS[split]} and {SPLITS[homes[group]]}")


def _write(path: Path, table: dict[str, NDArray[Any]]) -> None:
    temporary = path.with_suffix(".tmp.npz")
    np.savez(temporary, **table)  # type: ignore[arg-type]
    temporary.replace(path)


def _load_pictures(
    source: Source, folder: Path, table: dict[str, NDArray[Any]], config: DataConfig, seed: int
) -> tuple[NDArray[np.int64], NDArray[np.uint16]]:
    """Pooled pictures of a seeded choice of trials; drawing goes on where an interrupted run stopped."""
    wanted = _choose(table["split"], config, seed)
    name = f"pooled-{_FORMAT}-{len(table['split'])}-{seed}-{hashlib.sha256(wanted.tobytes()).hexdigest()[:8]}"
    shape = (len(wanted), WINDOW, 2, CHANNELS, ROWS, COLS)
    path, marker = folder / f"{name}.npy", folder / f"{name}.done"
    done = int(marker.read_text()) if marker.exists() else 0
    mode = "r+" if path.exists() and done else "w+"
    pooled = np.lib.format.open_memmap(path, mode=mode, dtype=np.uint16, shape=shape if mode == "w+" else None)
    todo: Iterable[int] = range(done, len(wanted))
    for row in track(todo, description="drawing pictures", disable=done == len(wanted), transient=True):
        trial = wanted[row]
        pooled[row] = pool_frames(source.frames(int(table["index"][trial]), int(table["start"][trial]), WINDOW))
        if row % 50 == 49 or row + 1 == len(wanted):
            pooled.flush()
            marker.write_text(str(row + 1))
    picture = np.full(len(table["split"]), -1, np.int64)
    picture[wanted] = np.arange(len(wanted))
    return picture, pooled


def _choose(split: NDArray[np.int64], config: DataConfig, seed: int) -> NDArray[np.int64]:
    rng = np.random.default_rng(seed)
    counts = (config.rendered_training, config.rendered_validation, config.rendered_test)
    chosen = []
    for code, count in enumerate(counts):
        members = rng.permutation(np.flatnonzero(split == code))
        chosen.append(members[:count])
    return np.concatenate(chosen)
