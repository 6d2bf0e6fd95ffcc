"""Trials in the LeRobot v3.0 layout: many episodes per Parquet file, images embedded, tables of episodes and tasks.

``data/chunk-000/file-000.parquet`` rows are frames; ``meta/info.json`` names the features; ``meta/episodes/...`` maps
rows to trials; ``meta/tasks.parquet`` and ``meta/stats.json`` complete it. Written with pyarrow alone.
``meta/trials.json`` is our addition, ignored by other readers: the sensor, and each trial's scalars from its shard.
Frames of drawn cells are equal steps of depth: their timestamps are nominal, and motion blur is that of a frame's time.
"""

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from reporting.files import write_json
from service.contract import Sensor
from service.durable import write_durably
from simulation.data.dataset import Dataset
from simulation.data.manifest import DatasetError, file_sha256, naming
from simulation.data.trial import FRAMES, Trial, arrays, from_row, stated

EPISODES_PER_FILE = 8  # about 100 MB of PNG, LeRobot's own limit per file
FILES_PER_CHUNK = 1000
CAMERAS = ("observation.images.left", "observation.images.right")
_DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
INFO, TRIALS = "meta/info.json", "meta/trials.json"
_EPISODES = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_HAND = ["x_mm", "y_mm", "z_mm", "rx_rad", "ry_rad", "rz_rad"]
_WRENCH = ["fx_n", "fy_n", "fz_n", "tx_nmm", "ty_nmm", "tz_nmm"]


def features(sensor: Sensor) -> dict[str, dict[str, Any]]:
    """The features of a frame as ``meta/info.json`` lists them."""
    image = {"dtype": "image", "shape": list(sensor.rectified.shape), "names": ["height", "width", "channels"]}
    vectors = {
        "observation.state": ["depth_mm", *_HAND],
        "observation.wrench": _WRENCH,
        "action": ["descend_mm"],
        "error": ["x_mm", "theta_deg"],
    }
    listed: dict[str, dict[str, Any]] = dict.fromkeys(CAMERAS, image)
    for name, names in vectors.items():
        listed[name] = {"dtype": "float32", "shape": [len(names)], "names": names}
    numbers_n = 2 * sensor.marker_rows * sensor.marker_columns * 3
    listed["observation.gel"] = {"dtype": "float32", "shape": [numbers_n], "names": None}
    listed["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
    for name in ("frame_index", "episode_index", "index", "task_index"):
        listed[name] = {"dtype": "int64", "shape": [1], "names": None}
    return listed


def export(dataset: Dataset, numbers: Sequence[int], out: Path, show: Callable[[int], None] = lambda _: None) -> None:
    """Write trials ``numbers`` of ``dataset`` under ``out``, which must not hold a dataset already."""
    tasks: dict[str, int] = {}
    episodes: list[dict[str, Any]] = []
    trials: list[dict[str, Any]] = []
    stats = _Stats()
    for first in range(0, len(numbers), EPISODES_PER_FILE):
        rows: list[dict[str, Any]] = []
        place = divmod(first // EPISODES_PER_FILE, FILES_PER_CHUNK)
        for episode, number in enumerate(numbers[first : first + EPISODES_PER_FILE], start=first):
            trial = dataset.trial(number)
            text = f"insert the {trial.object_name} into the gap"
            task = tasks.setdefault(text, len(tasks))
            frames = dataset.frames(number, 0, FRAMES)
            rows += _rows(trial, frames, episode, task)
            trials.append(stated(trial))
            own = _Stats()
            own.add(rows[-FRAMES:], frames)
            stats.merge(own)
            episodes.append(_episode(episode, text, place) | own.columns())
            show(len(episodes))
        path = out / _DATA.format(chunk_index=place[0], file_index=place[1])
        _write(path, rows, _data_schema(dataset.manifest.sensor))
    (out / TRIALS).parent.mkdir(parents=True, exist_ok=True)
    write_json(out / TRIALS, {"sensor": dataset.manifest.sensor.model_dump(mode="json"), "trials": trials})
    _write_meta(out, tasks, episodes, stats, dataset.manifest.sensor)


@dataclass(frozen=True, slots=True)
class Contents:
    """Contents of an export: its sensor, and one digest of all its files."""

    sensor: Sensor
    digest: str

    def sha256(self) -> str:
        """The digest, under the name that a manifest uses."""
        return self.digest


class Exported:
    """Reads what :func:`export` wrote as a `Dataset` reads shards: the same trials, and frames from the images.

    Raises DatasetError where ``path`` holds no such export: other LeRobot datasets do not state the onset of motion.
    """

    def __init__(self, path: Path) -> None:
        import pyarrow.parquet as pq

        try:
            kept = json.loads((path / TRIALS).read_text(encoding="utf-8"))
            sensor, self._trials = Sensor.model_validate(kept["sensor"]), list(kept["trials"])
            rows = pq.read_table(path / "meta/episodes").to_pylist()
            places = [(row["data/chunk_index"], row["data/file_index"]) for row in rows]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise DatasetError(f"{path}: no dataset that `export-dataset` wrote, {TRIALS}: {error}") from error
        self._files = [path / _DATA.format(chunk_index=chunk, file_index=file) for chunk, file in places]
        if len(places) != len(self._trials):
            raise DatasetError(f"{path}: {len(self._trials)} trials in {TRIALS}, {len(places)} in meta/episodes")
        for file in dict.fromkeys(self._files):
            try:
                pq.read_metadata(file)
            except (OSError, ValueError) as error:
                raise DatasetError(f"{file}: not a Parquet file: {error}") from error
        listed = "\n".join(file_sha256(file) for file in (path / TRIALS, *dict.fromkeys(self._files)))
        self.manifest = Contents(sensor, hashlib.sha256(listed.encode()).hexdigest())

    def __len__(self) -> int:
        return len(self._trials)

    def trial(self, index: int) -> Trial:
        """Trial ``index``, checked."""
        names = ("observation.gel", "observation.state", "observation.wrench")
        with naming(self._files[index], index):
            gel, state, wrench = (np.array(column) for column in self._columns(index, names))
            parts = {"gel": gel, "depth_mm": state[:, 0], "wrench": wrench, "in_hand": state[:, 1:]}
            row = {name: parts[name].astype(kind).tobytes() for name, (_, kind) in arrays(self.manifest.sensor).items()}
            trial = from_row({**self._trials[index], **row}, self.manifest.sensor)
            trial.check()
        return trial

    def frames(self, index: int, start: int, count: int) -> NDArray[np.uint8]:
        """Uint8 [count, 2, H, W, 3] BGR, lossless."""
        with naming(self._files[index], index):
            pairs = list(zip(*self._columns(index, CAMERAS), strict=True))[start : start + count]
            return np.array([[_drawn(picture["bytes"]) for picture in pair] for pair in pairs], np.uint8)

    def _columns(self, index: int, names: Sequence[str]) -> list[list[Any]]:
        import pyarrow.parquet as pq

        path = self._files[index]
        table = pq.read_table(path, columns=list(names), filters=[("episode_index", "=", index)])
        if len(table) != FRAMES:
            raise DatasetError(f"{len(table)} frames, expected {FRAMES}")
        return [table[name].to_pylist() for name in names]


def _rows(trial: Trial, frames: NDArray[np.uint8], episode: int, task: int) -> list[dict[str, Any]]:
    state = np.concatenate([trial.depth_mm[:, None], trial.in_hand], axis=1)
    descend_mm = np.diff(trial.depth_mm, append=trial.depth_mm[-1:])
    gel = trial.gel.astype(np.float32).reshape(FRAMES, -1)
    rows = []
    for k in range(FRAMES):
        row: dict[str, Any] = {camera: _png(frames[k, finger]) for finger, camera in enumerate(CAMERAS)}
        row |= {"observation.state": state[k], "observation.wrench": trial.wrench[k], "observation.gel": gel[k]}
        row |= {"action": descend_mm[k], "error": [trial.x_mm, trial.theta_deg], "timestamp": k / trial.sensor.fps}
        row |= {"frame_index": k, "episode_index": episode, "index": episode * FRAMES + k, "task_index": task}
        rows.append(row)
    return rows


def _drawn(png: bytes) -> Any:
    return cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)


def _png(frame: NDArray[np.uint8]) -> dict[str, Any]:
    done, data = cv2.imencode(".png", frame)
    assert done
    return {"bytes": data.tobytes(), "path": None}


def _episode(episode: int, task: str, place: tuple[int, int]) -> dict[str, Any]:
    start = episode * FRAMES
    return {
        "episode_index": episode,
        "tasks": [task],
        "length": FRAMES,
        "dataset_from_index": start,
        "dataset_to_index": start + FRAMES,
        "data/chunk_index": place[0],
        "data/file_index": place[1],
        "meta/episodes/chunk_index": 0,
        "meta/episodes/file_index": 0,
    }


def _data_schema(sensor: Sensor) -> Any:
    """Arrow schema of the frames, with the column types from which Hugging Face `datasets` reads images."""
    import pyarrow as pa

    image = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
    fields: list[Any] = []
    types: dict[str, Any] = {}
    for name, feature in features(sensor).items():
        size, scalar = feature["shape"][0], feature["dtype"]
        if scalar == "image":
            kind, types[name] = image, {"_type": "Image"}
        elif size == 1:
            kind, types[name] = pa.type_for_alias(scalar), {"dtype": scalar, "_type": "Value"}
        else:
            kind = pa.list_(pa.type_for_alias(scalar), size)
            types[name] = {"feature": {"dtype": scalar, "_type": "Value"}, "length": size, "_type": "Sequence"}
        fields.append(pa.field(name, kind))
    return pa.schema(fields, metadata={"huggingface": json.dumps({"info": {"features": types}})})


def _write(path: Path, rows: list[dict[str, Any]], schema: Any = None) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    path.parent.mkdir(parents=True, exist_ok=True)
    sink = pa.BufferOutputStream()
    pq.write_table(pa.Table.from_pylist(rows, schema=schema), sink, row_group_size=FRAMES, compression="snappy")
    write_durably(path, sink.getvalue().to_pybytes())


def _write_meta(
    out: Path, tasks: dict[str, int], episodes: list[dict[str, Any]], stats: "_Stats", sensor: Sensor
) -> None:
    import pyarrow as pa

    _write(out / _EPISODES.format(chunk_index=0, file_index=0), episodes)
    # pandas restores the task text as the index, where LeRobot looks for it
    columns = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy, "metadata": None}
        for name, kind, numpy in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    ]
    index = {"index_columns": ["task"], "column_indexes": [], "columns": columns, "pandas_version": "2.0.0"}
    schema = pa.schema([("task_index", pa.int64()), ("task", pa.string())], metadata={"pandas": json.dumps(index)})
    rows = [{"task_index": number, "task": text} for text, number in tasks.items()]
    _write(out / "meta/tasks.parquet", rows, schema)
    info = {
        "codebase_version": "v3.0",
        "robot_type": "two tactile fingers on a parallel gripper (simulated)",
        "total_episodes": len(episodes),
        "total_frames": len(episodes) * FRAMES,
        "total_tasks": len(tasks),
        "chunks_size": FILES_PER_CHUNK,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": sensor.fps,
        "splits": {"train": f"0:{len(episodes)}"},
        "data_path": _DATA,
        "video_path": None,
        "features": features(sensor),
    }
    write_json(out / "meta/stats.json", stats.result())
    write_json(out / INFO, info)  # last: its presence marks a complete folder


class _Stats:
    """Minimum, maximum, mean and standard deviation of every feature over frames; images per channel in 0..1."""

    def __init__(self) -> None:
        self.sums: dict[str, list[NDArray[np.float64]]] = {}
        self.counts: dict[str, int] = {}

    def merge(self, other: "_Stats") -> None:
        """Add the sums of another one."""
        for name, new in other.sums.items():
            self._one(name, new, other.counts[name])

    def add(self, rows: list[dict[str, Any]], frames: NDArray[np.uint8]) -> None:
        """One trial: its rows and its frames [30, 2, H, W, 3] BGR."""
        for finger, camera in enumerate(CAMERAS):
            self._values(camera, frames[:, finger, ::4, ::4, ::-1].reshape(-1, 3) / 255)
        for name in rows[0].keys() - set(CAMERAS):
            self._values(name, np.asarray([np.atleast_1d(row[name]) for row in rows], np.float64))

    def _values(self, name: str, values: NDArray[np.float64]) -> None:
        self._one(name, [values.min(0), values.max(0), values.sum(0), (values**2).sum(0)], len(values))

    def _one(self, name: str, new: list[NDArray[np.float64]], count: int) -> None:
        old = self.sums.get(name, [new[0], new[1], 0 * new[2], 0 * new[3]])
        merged = [np.minimum(old[0], new[0]), np.maximum(old[1], new[1]), old[2] + new[2], old[3] + new[3]]
        self.sums[name], self.counts[name] = merged, self.counts.get(name, 0) + count

    def columns(self) -> dict[str, Any]:
        """The result as columns of the table of episodes: ``stats/FEATURE/FIGURE``."""
        results = self.result()
        return {f"stats/{name}/{key}": value for name, figures in results.items() for key, value in figures.items()}

    def result(self) -> dict[str, dict[str, Any]]:
        """Feature -> min, max, mean, std, count; channels of images as [3, 1, 1]."""
        results = {}
        for name, (low, high, total, squares) in self.sums.items():
            count = self.counts[name]
            mean = total / count
            spread = np.sqrt(np.maximum(squares / count - mean**2, 0))
            shape = (-1, 1, 1) if name in CAMERAS else (-1,)
            figures = {"min": low, "max": high, "mean": mean, "std": spread}
            results[name] = {key: value.reshape(shape).tolist() for key, value in figures.items()} | {"count": [count]}
        return results
