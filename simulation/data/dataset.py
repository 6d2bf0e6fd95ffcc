"""Datasets of pokes: Parquet shards and one manifest; frames are drawn from gel states when they are read.

A dataset is a folder: ``manifest.json`` and ``*.parquet``. Only files listed in the manifest count. A shard is listed
after it is complete and on disk, so a kill at any moment loses no listed trial and duplicates none. Each row holds
everything needed to draw its trial's frames (gel states, optics, seed): the same row gives the same bits. This is the
only module of the simulator that training may import.
"""

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from service.contract import Sensor
from service.durable import locked, write_durably
from simulation.data.manifest import MANIFEST, DatasetError, Manifest, ShardEntry, naming, read_manifest
from simulation.data.trial import (
    LABELS,
    SCALARS,
    Trial,
    from_row,
    parquet_schema,
    render_frames,
    to_row,
)
from simulation.optics.appearance import Appearance

_ROWS_PER_GROUP = 10
_CACHED_GROUPS = 16
_CACHED_RENDERERS = 32


class DatasetWriter:
    """Adds complete shards to a dataset folder; the manifest on disk is always true. Close it, or use ``with``."""

    def __init__(self, path: Path, fresh: Manifest) -> None:
        """Create the folder or continue the existing one.

        DatasetError, with nothing changed, if it holds another collection, broken shards, or has another writer.
        """
        self.path = path
        path.mkdir(parents=True, exist_ok=True)
        try:
            self._lock = locked(path)
        except BlockingIOError as error:
            raise DatasetError(f"{path}: another process is writing to this dataset") from error
        try:
            self.manifest = self._opened(fresh)
        except BaseException:
            self.close()
            raise

    def _opened(self, fresh: Manifest) -> Manifest:
        if not (self.path / MANIFEST).exists():
            write_durably(self.path / MANIFEST, fresh.model_dump_json(indent=1))
            return fresh
        manifest = read_manifest(self.path)
        manifest.must_continue(fresh, self.path)
        for entry in manifest.shards:
            entry.must_be_whole(self.path)
        for leftover in self.path.glob(".*.tmp"):
            leftover.unlink()
        return manifest

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def commit(self, entry: ShardEntry) -> None:
        """List a shard that is on disk. Each name is listed once."""
        if any(listed.name == entry.name for listed in self.manifest.shards):
            raise DatasetError(f"shard {entry.name} is already in {self.path / MANIFEST}")
        shards = tuple(sorted((*self.manifest.shards, entry), key=lambda listed: listed.order))
        self.manifest = self.manifest.model_copy(update={"shards": shards})
        self._save()

    def extend(self, asked: Manifest) -> None:
        """Adopt a larger size or more objects; the dataset is incomplete until :meth:`finish`.

        DatasetError, with nothing changed, if the new shards would be made by other physics than the existing ones.
        """
        larger = max(self.manifest.trials_per_object, asked.trials_per_object)
        update = {"scenes": self.manifest.scenes | asked.scenes, "trials_per_object": larger, "complete": False}
        larger_one = self.manifest.model_copy(update=update)
        mixed = bool(self.manifest.physics) and self.manifest.physics != asked.physics
        if mixed and larger_one.missing_shards():
            raise DatasetError(f"{self.path}: the physics has changed since its shards were made; use another folder")
        self.manifest = larger_one
        self._save()

    def finish(self) -> bool:
        """Mark the dataset complete if every object has all its shards; returns whether it is."""
        complete = not self.manifest.missing_shards()
        self.manifest = self.manifest.model_copy(update={"complete": complete})
        self._save()
        return complete

    def close(self) -> None:
        self._lock.close()

    def _save(self) -> None:
        write_durably(self.path / MANIFEST, self.manifest.model_dump_json(indent=1))


def encode_shard(
    name: str, trials: Sequence[Trial], outcomes: Mapping[str, int] | None = None
) -> tuple[ShardEntry, bytes]:
    """Check trials and encode them as the shard ``name``: the entry to list it with and the file's bytes."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    for trial in trials:
        trial.check()
    sensor = trials[0].sensor if trials else Sensor.load()
    drawn = bool(trials) and all(trial.drawn for trial in trials)
    schema = parquet_schema(sensor, drawn=drawn)
    table = pa.Table.from_pylist([to_row(trial) for trial in trials], schema=schema)
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, row_group_size=_ROWS_PER_GROUP, compression="zstd", use_dictionary=["appearances"])
    data = sink.getvalue().to_pybytes()
    object_name = trials[0].object_name if trials else ""
    entry = ShardEntry.of(name, data, trials=len(trials), object_name=object_name, outcomes=dict(outcomes or {}))
    return entry, data


class Dataset:
    """Reads a dataset; trials are numbered 0.. over the shards in manifest order.

    Raises DatasetError, naming the shard before anything is used, on a missing, truncated or altered shard, another
    schema version, or labels that are not finite.
    """

    def __init__(self, path: str | Path, *, verify: bool = True) -> None:
        """Open ``path``; ``verify`` compares every shard's SHA-256 (0.1 s each)."""
        self.path = Path(path)
        self.manifest = read_manifest(self.path)
        self._groups: OrderedDict[tuple[int, int], list[dict[str, Any]]] = OrderedDict()
        self._renderers: OrderedDict[Appearance, Any] = OrderedDict()
        self._files: dict[int, Any] = {}
        self._where: list[tuple[int, int, int]] = []  # shard, row group and row in it
        for shard, entry in enumerate(self.manifest.shards):
            entry.must_be_whole(self.path, verify=verify)
            self._must_be_labelled(shard)
            self._where += [(shard, *place) for place in self._rows(shard)]

    def __len__(self) -> int:
        return len(self._where)

    def trial(self, index: int) -> Trial:
        """Trial ``index``, checked; its arrays are read-only views."""
        shard, group, row = self._where[index]
        with naming(self.path / self.manifest.shards[shard].name, index):
            trial = from_row(self._row_group(shard, group)[row], self.manifest.sensor)
            trial.check()
        return trial

    def frames(self, index: int, start: int | None = None, count: int = 8) -> NDArray[np.uint8]:
        """Uint8 [count, 2, H, W, 3]: rectified frames from ``start`` (the onset if None), both fingers.

        The same (dataset, index, frame) gives the same bits in every process.
        """
        trial = self.trial(index)
        return render_frames(trial, self._renderer, trial.onset_frame if start is None else start, count)

    def _renderer(self, look: Appearance) -> Any:
        from simulation.optics.renderer import Renderer

        if look not in self._renderers:
            self._renderers[look] = Renderer(look)
            if len(self._renderers) > _CACHED_RENDERERS:
                self._renderers.popitem(last=False)
        return self._renderers[look]

    def _file(self, shard: int) -> Any:
        import pyarrow as pa
        import pyarrow.parquet as pq

        if shard not in self._files:
            path = self.path / self.manifest.shards[shard].name
            try:
                self._files[shard] = pq.ParquetFile(path, memory_map=True)
            except (pa.ArrowException, OSError) as error:
                raise DatasetError(f"{path}: not a Parquet shard: {error}") from error
            schema = self._files[shard].schema_arrow
            sensor = self.manifest.sensor
            if not any(schema.equals(parquet_schema(sensor, drawn=drawn)) for drawn in (False, True)):
                raise DatasetError(f"{path}: its columns are not those of sensor {sensor}")
        return self._files[shard]

    def _rows(self, shard: int) -> list[tuple[int, int]]:
        """Row group of each trial of a shard and its row there: another program may have written larger groups."""
        about = self._file(shard).metadata
        return [(group, row) for group in range(about.num_row_groups) for row in range(about.row_group(group).num_rows)]

    def _must_be_labelled(self, shard: int) -> None:
        name = self.path / self.manifest.shards[shard].name
        try:
            columns = self._file(shard).read(columns=list(SCALARS)).to_pydict()
        except OSError as error:
            raise DatasetError(f"{name}: not a Parquet shard: {error}") from error
        for label in LABELS:
            if not np.isfinite(np.asarray(columns[label], float)).all():
                raise DatasetError(f"{name}: label {label} holds a number that is not finite")
        if len(columns["x_mm"]) != self.manifest.shards[shard].trials:
            stated = self.manifest.shards[shard].trials
            raise DatasetError(f"{name}: {len(columns['x_mm'])} trials, the manifest says {stated}")

    def _row_group(self, shard: int, group: int) -> list[dict[str, Any]]:
        key = (shard, group)
        if key not in self._groups:
            rows: list[dict[str, Any]] = self._file(shard).read_row_group(group).to_pylist()
            self._groups[key] = rows
            if len(self._groups) > _CACHED_GROUPS:
                self._groups.popitem(last=False)
        self._groups.move_to_end(key)
        return self._groups[key]

    def __getstate__(self) -> dict[str, Any]:
        """Leave open files out of the copy that a worker process gets."""
        return self.__dict__ | {"_files": {}, "_groups": OrderedDict(), "_renderers": OrderedDict()}


def slice_of(numbers: Sequence[int], first: int, count: int, source: Path) -> list[int]:
    """``count`` of the trials' ``numbers`` starting at index ``first``; DatasetError if there are none."""
    if first < 0 or count < 1:
        raise DatasetError(f"--first {first} --count {count}: expected 0 or more and 1 or more")
    chosen = list(numbers[first : first + count])
    if not chosen:
        raise DatasetError(f"{source}: no trials from number {first} on, it has {len(numbers)}")
    return chosen
