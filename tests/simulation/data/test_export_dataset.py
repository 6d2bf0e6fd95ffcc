"""Exports: other people's readers find every trial, frame for frame."""

import base64
import json
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader

from simulation.cli.dataset import export_dataset
from simulation.data.dataset import Dataset, DatasetError, DatasetWriter
from tests.simulation.strategies import made_up_manifest, made_up_trial


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of 10 trials."""
    folder = tmp_path_factory.mktemp("source")
    with DatasetWriter(folder, made_up_manifest(trials_per_object=10, trials_per_shard=10)) as writer:
        writer.commit(writer.write_shard("rectangle-00000.parquet", [made_up_trial(k) for k in range(10)]))
        writer.finish()
    return folder


@pytest.fixture(scope="module")
def lerobot(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("lerobot")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("simulation.data.lerobot.EPISODES_PER_FILE", 2)
        assert export_dataset([str(source), "--out", str(out), "--count", "3"]) == 0
    return out


def test_lerobot_tables_agree_with_info(lerobot: Path) -> None:
    info = json.loads((lerobot / "meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (3, 90, 1)
    files = sorted(lerobot.glob("data/*/*.parquet"))
    assert [file.name for file in files] == ["file-000.parquet", "file-001.parquet"]
    tables = [pq.read_table(file) for file in files]
    assert set(tables[0].column_names) == set(info["features"])
    assert sum(len(table) for table in tables) == 90
    assert [n for table in tables for n in table["index"].to_pylist()] == list(range(90))
    episodes = pq.read_table(lerobot / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    for episode in episodes:
        place = {"chunk_index": episode["data/chunk_index"], "file_index": episode["data/file_index"]}
        table = pq.read_table(lerobot / info["data_path"].format(**place))
        rows = table.filter(np.asarray(table["episode_index"]) == episode["episode_index"])
        span = range(episode["dataset_from_index"], episode["dataset_to_index"])
        assert rows["index"].to_pylist() == list(span)
    stats = json.loads((lerobot / "meta/stats.json").read_text())
    assert set(stats) == set(info["features"])
    assert np.asarray(stats["observation.images.left"]["mean"]).shape == (3, 1, 1)


def test_lerobot_frames_are_the_dataset_s_without_loss(source: Path, lerobot: Path) -> None:
    row = pq.read_table(lerobot / "data/chunk-000/file-001.parquet").slice(12, 1).to_pylist()[0]
    frames = Dataset(source).frames(2, 12, 1)
    for finger, camera in enumerate(("left", "right")):
        data = np.frombuffer(row[f"observation.images.{camera}"]["bytes"], np.uint8)
        assert np.array_equal(cv2.imdecode(data, cv2.IMREAD_COLOR), frames[0, finger])
    trial = made_up_trial(2)
    assert row["error"] == pytest.approx([trial.x_mm, trial.theta_deg])
    assert np.allclose(np.reshape(row["observation.gel"], (2, 20, 21, 3)), trial.gel[12])


def test_mcap_holds_images_dots_and_truth(source: Path, tmp_path: Path) -> None:
    command = [str(source), "--out", str(tmp_path / "out"), "--layout", "mcap", "--first", "3", "--count", "1"]
    assert export_dataset(command) == 0
    with (tmp_path / "out/trial-000003.mcap").open("rb") as file:
        reader = make_reader(file)
        metadata = {entry.name: entry.metadata for entry in reader.iter_metadata()}
        found: dict[str, list[dict[str, object]]] = {}
        for _, channel, message in reader.iter_messages():
            found.setdefault(channel.topic, []).append(json.loads(message.data))
    assert set(found) == {"/left/image", "/right/image", "/left/markers", "/right/markers", "/state"}
    assert all(len(messages) == 30 for messages in found.values())
    trial = made_up_trial(3)
    assert float(metadata["trial"]["x_mm"]) == trial.x_mm
    image = np.frombuffer(base64.b64decode(str(found["/right/image"][7]["data"])), np.uint8)
    assert np.array_equal(cv2.imdecode(image, cv2.IMREAD_COLOR), Dataset(source).frames(3, 7, 1)[0, 1])
    moved = np.asarray(found["/left/markers"][7]["displacement_px"])
    assert np.allclose(moved, trial.gel[7, 0, ..., :2] / 0.07, atol=1e-2)


def test_nothing_is_overwritten_and_nothing_is_made_up(source: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(DatasetError, match="not empty"):
        export_dataset([str(source), "--out", str(tmp_path)])
    with pytest.raises(DatasetError, match="no trials from number 99"):
        export_dataset([str(source), "--out", str(tmp_path / "new"), "--first", "99"])
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]
