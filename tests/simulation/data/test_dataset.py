"""Datasets: listed shards are complete, data round-trips, and broken data are named and left unchanged."""

import hashlib
import json
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from simulation.data.dataset import Dataset, DatasetError, DatasetWriter
from simulation.data.manifest import ShardEntry
from simulation.data.trial import LABELS, split_of
from tests.simulation.strategies import made_up_dataset, made_up_manifest, made_up_trial, written


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two committed shards of 12 trials, complete."""
    return made_up_dataset(tmp_path, [made_up_trial(k) for k in range(24)])


def test_trials_come_back_exactly(folder: Path) -> None:
    dataset = Dataset(folder)
    assert len(dataset) == 24
    assert dataset.manifest.complete
    for index in (0, 9, 10, 11, 12, 23):
        read, written = dataset.trial(index), made_up_trial(index)
        for name in written.__slots__:
            assert np.array_equal(getattr(read, name), getattr(written, name)), name


def test_frames_are_the_same_every_time(folder: Path) -> None:
    first, second = Dataset(folder), Dataset(folder)
    frames = first.frames(13, count=2)
    assert frames.shape == (2, 2, 320, 327, 3)
    assert frames.dtype == np.uint8
    second.frames(3, count=1)
    assert np.array_equal(second.frames(13, count=2), frames)
    assert np.array_equal(second.frames(13, 16, 1)[0], frames[1])
    copied: Dataset = pickle.loads(pickle.dumps(first))
    assert np.array_equal(copied.frames(13, count=2), frames)


def test_another_process_draws_the_same_bits(folder: Path) -> None:
    code = (
        "import hashlib, sys; from simulation.data.dataset import Dataset;"
        "print(hashlib.sha256(Dataset(sys.argv[1]).frames(13, count=2).tobytes()).hexdigest())"
    )
    command = [sys.executable, "-c", code, str(folder)]
    other = subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()
    assert other == hashlib.sha256(Dataset(folder).frames(13, count=2).tobytes()).hexdigest()


def test_every_trial_states_its_split(folder: Path) -> None:
    dataset = Dataset(folder)
    splits = [dataset.trial(index).split for index in range(len(dataset))]
    assert [splits.count(split) for split in ("train", "validation", "test")] == [12, 6, 6]


def test_the_split_depends_on_the_group_alone() -> None:
    assert all(split_of(group, held_out=True) == "test" for group in range(50))
    splits = [split_of(group, held_out=False) for group in range(2000)]
    assert splits == [split_of(group, held_out=False) for group in range(2000)]
    assert 0.12 < splits.count("validation") / len(splits) < 0.18
    assert "test" not in splits


def test_frames_outside_the_trial_are_refused(folder: Path) -> None:
    with pytest.raises(DatasetError, match=r"frames 25\.\.32"):
        Dataset(folder).frames(0, 25, 8)


def shard(folder: Path) -> Path:
    return folder / "rectangle-00001.parquet"


def test_a_truncated_shard_is_named_and_left_alone(folder: Path) -> None:
    shard(folder).write_bytes(shard(folder).read_bytes()[:-100])
    before = {path: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(DatasetError, match=r"rectangle-00001\.parquet: .* bytes.*truncated"):
        Dataset(folder)
    with pytest.raises(DatasetError, match="truncated"):
        DatasetWriter(folder, made_up_manifest())
    assert before == {path: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("rows", [5, 11, 100])
def test_a_shard_that_another_program_wrote_again_is_read_row_by_row(folder: Path, rows: int) -> None:
    """Other programs choose other row groups."""
    before = [Dataset(folder).trial(index) for index in range(24)]
    pq.write_table(pq.read_table(shard(folder)), shard(folder), row_group_size=rows)
    stated = json.loads((folder / "manifest.json").read_text())
    entry = ShardEntry.of(shard(folder).name, shard(folder).read_bytes(), trials=12, object_name="", outcomes={})
    stated["shards"][1] |= {"size_bytes": entry.size_bytes, "sha256": entry.sha256}
    (folder / "manifest.json").write_text(json.dumps(stated))
    again = Dataset(folder)
    for index, trial in enumerate(before):
        assert again.trial(index).seed == trial.seed
        assert np.array_equal(again.trial(index).gel, trial.gel)


def test_a_missing_shard_is_named(folder: Path) -> None:
    shard(folder).unlink()
    with pytest.raises(DatasetError, match=r"rectangle-00001\.parquet: listed .* but missing"):
        Dataset(folder)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"schema_version": 3}, "schema version 3, expected 2"),
        ({"surprise": 1}, "surprise"),
        ({"seed": "zero"}, "seed"),
    ],
)
def test_a_manifest_of_another_version_is_refused_and_kept(
    folder: Path, change: dict[str, object], message: str
) -> None:
    path = folder / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    before = path.read_bytes()
    for opener in (Dataset, lambda where: DatasetWriter(where, made_up_manifest())):
        with pytest.raises(DatasetError, match=message):
            opener(folder)
    assert path.read_bytes() == before


def test_no_dataset_is_said_so(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="no such file"):
        Dataset(tmp_path)


@pytest.mark.parametrize("name", LABELS)
def test_labels_that_are_not_numbers_are_refused_on_writing_and_on_reading(
    folder: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    bad = made_up_trial(0, **{name: float("nan")})
    with DatasetWriter(folder, made_up_manifest()) as writer:
        with pytest.raises(DatasetError, match=name):
            written(folder / "bad.parquet", [bad])
        monkeypatch.setattr("simulation.data.trial.Trial.check", lambda _: None)  # as a writer with a bug would
        writer.commit(written(folder / "bad.parquet", [bad]))
    with pytest.raises(DatasetError, match=rf"bad\.parquet: label {name}"):
        Dataset(folder)


def test_another_collection_is_not_continued(folder: Path) -> None:
    with pytest.raises(DatasetError, match="seed is 0, asked for 1"):
        DatasetWriter(folder, made_up_manifest(seed=1))
    with pytest.raises(DatasetError, match="scene rectangle has changed"):
        DatasetWriter(folder, made_up_manifest(scenes={"rectangle": "1" * 64}))


def test_two_writers_cannot_share_a_folder(folder: Path) -> None:
    with DatasetWriter(folder, made_up_manifest()), pytest.raises(DatasetError, match="another process"):
        DatasetWriter(folder, made_up_manifest())


def test_growing_makes_a_complete_dataset_incomplete_until_filled(folder: Path) -> None:
    with DatasetWriter(folder, made_up_manifest()) as writer:
        writer.extend(made_up_manifest(trials_per_object=36))
        assert not Dataset(folder).manifest.complete
        assert writer.manifest.missing_shards() == [("rectangle", 2)]
        assert not writer.finish()


def test_what_a_killed_writer_left_is_swept(folder: Path) -> None:
    leftover = folder / ".rectangle-00002.parquet.99.tmp"
    leftover.write_bytes(b"half")
    DatasetWriter(folder, made_up_manifest()).close()
    assert not leftover.exists()


def test_equal_trials_give_equal_bytes(tmp_path: Path) -> None:
    trials = [made_up_trial(k) for k in range(12)]
    assert written(tmp_path / "a.parquet", trials).sha256 == written(tmp_path / "b.parquet", trials).sha256
