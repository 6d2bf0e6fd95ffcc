"""Exports: other people's readers find every trial, frame for frame."""

import dataclasses
import json
import os
import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest

from simulation.cli.dataset import export_dataset
from simulation.data.dataset import Dataset, DatasetError
from simulation.data.lerobot import TRIALS, Exported
from tests.simulation.strategies import made_up_dataset, made_up_trial


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of 10 trials."""
    return made_up_dataset(tmp_path_factory.mktemp("source"), [made_up_trial(k) for k in range(10)], 10)


@pytest.fixture(scope="module")
def lerobot(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("lerobot")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("simulation.data.lerobot.EPISODES_PER_FILE", 1)
        assert export_dataset([str(source), "--out", str(out), "--count", "2"]) == 0
    return out


def test_lerobot_tables_agree_with_info(lerobot: Path) -> None:
    info = json.loads((lerobot / "meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (2, 60, 1)
    files = sorted(lerobot.glob("data/*/*.parquet"))
    assert [file.name for file in files] == ["file-000.parquet", "file-001.parquet"]
    tables = [pq.read_table(file) for file in files]
    assert set(tables[0].column_names) == set(info["features"])
    assert sum(len(table) for table in tables) == 60
    assert [n for table in tables for n in table["index"].to_pylist()] == list(range(60))
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


def test_the_statistics_of_an_episode_are_of_its_own_frames(source: Path, lerobot: Path) -> None:
    episodes = pq.read_table(lerobot / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    features = json.loads((lerobot / "meta/info.json").read_text())["features"]
    for number, episode in enumerate(episodes):
        means = {name: episode[f"stats/{name}/mean"] for name in features}
        trial = made_up_trial(number)
        assert means["error"] == pytest.approx([trial.x_mm, trial.theta_deg])
        assert means["observation.wrench"] == pytest.approx(trial.wrench.mean(0), rel=1e-4, abs=1e-5)
        blue_last = Dataset(source).frames(number, 0, 30)[:, 0, ::4, ::4, ::-1].mean((0, 1, 2)) / 255
        assert np.ravel(means["observation.images.left"]) == pytest.approx(blue_last)
        assert episode["stats/error/count"] == [30]


LOADED = """
import json, sys
import numpy as np, torch
from lerobot.datasets.compute_stats import aggregate_stats
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.utils import flatten_dict, unflatten_dict
import pandas
from importlib.metadata import version
data = LeRobotDataset("local/trials", root=sys.argv[1])
rows = pandas.read_parquet(sys.argv[1] + "/meta/episodes/chunk-000/file-000.parquet").to_dict("records")
def flat(value):
    return np.array([flat(one) for one in value]) if isinstance(value, (list, np.ndarray)) else value
each = [unflatten_dict({k[6:]: flat(v) for k, v in row.items() if k.startswith("stats/")}) for row in rows]
total = aggregate_stats(each)
gaps = [float(np.abs(np.asarray(data.meta.stats[n][k]) - total[n][k]).max()) for n in total for k in ("mean", "std")]
item = data[42]
print(json.dumps({
    "version": version("lerobot"), "frames": len(data), "episodes": data.num_episodes, "fps": data.fps,
    "gap": max(gaps), "image": list(item["observation.images.left"].shape), "task": item["task"],
    "mean": item["observation.images.left"].mean((1, 2)).tolist(), "error": item["error"].tolist(),
    "loaded": [int(one["frame_index"]) for one in torch.utils.data.DataLoader(data, batch_size=None)][:31],
}))
"""


def test_lerobot_s_own_loader_reads_every_frame_and_agrees_with_the_statistics(source: Path, lerobot: Path) -> None:
    python = os.environ.get("LEROBOT_PYTHON")
    if not python:
        pytest.skip("set LEROBOT_PYTHON to a Python with lerobot (make peers LEROBOT=1 does; it is gigabytes)")
    offline = {**os.environ, "HF_HUB_OFFLINE": "1", "HF_HOME": str(lerobot / "cache")}
    done = subprocess.run(
        [python, "-c", LOADED, str(lerobot)], capture_output=True, text=True, env=offline, check=False
    )
    assert done.returncode == 0, done.stderr
    loaded = json.loads(done.stdout.splitlines()[-1])
    assert (loaded["frames"], loaded["episodes"], loaded["fps"]) == (60, 2, 30)
    assert loaded["gap"] < 1e-6
    trial, frames = made_up_trial(1), Dataset(source).frames(1, 12, 1)
    assert loaded["image"] == [3, *frames.shape[2:4]]
    assert loaded["mean"] == pytest.approx(frames[0, 0, ..., ::-1].mean((0, 1)) / 255, abs=1e-6)
    assert loaded["error"] == pytest.approx([trial.x_mm, trial.theta_deg])
    assert loaded["task"] == "insert the rectangle into the gap"
    assert loaded["loaded"] == [*range(30), 0]


def test_lerobot_frames_are_the_dataset_s_without_loss(source: Path, lerobot: Path) -> None:
    row = pq.read_table(lerobot / "data/chunk-000/file-001.parquet").slice(12, 1).to_pylist()[0]
    frames = Dataset(source).frames(1, 12, 1)
    for finger, camera in enumerate(("left", "right")):
        data = np.frombuffer(row[f"observation.images.{camera}"]["bytes"], np.uint8)
        assert np.array_equal(cv2.imdecode(data, cv2.IMREAD_COLOR), frames[0, finger])
    trial = made_up_trial(1)
    assert row["error"] == pytest.approx([trial.x_mm, trial.theta_deg])
    assert np.allclose(np.reshape(row["observation.gel"], (2, 20, 21, 3)), trial.gel[12])


def test_an_export_is_read_again_as_the_shards_are(source: Path, lerobot: Path) -> None:
    shards, exported = Dataset(source), Exported(lerobot)
    assert len(exported) == 2
    assert exported.manifest.sensor == shards.manifest.sensor
    for index in range(2):
        was, now = shards.trial(index), exported.trial(index)
        for field in dataclasses.fields(was):
            assert np.array_equal(getattr(was, field.name), getattr(now, field.name)), field.name
    assert np.array_equal(exported.frames(1, 12, 3), shards.frames(1, 12, 3))


def test_an_export_that_was_altered_is_another_and_another_s_dataset_is_refused(lerobot: Path, tmp_path: Path) -> None:
    mine = Path(shutil.copytree(lerobot, tmp_path / "mine"))
    before = Exported(mine).manifest.sha256()
    assert before == Exported(lerobot).manifest.sha256()
    kept = json.loads((mine / TRIALS).read_text())
    kept["trials"][0]["x_mm"] += 1.0
    (mine / TRIALS).write_text(json.dumps(kept))
    assert Exported(mine).manifest.sha256() != before
    (mine / TRIALS).unlink()
    with pytest.raises(DatasetError, match="no dataset that `export-dataset` wrote"):
        Exported(mine)


@pytest.mark.parametrize("kept", [0, 0.5, None], ids=["empty", "half", "missing"])
def test_an_export_with_a_damaged_file_of_frames_is_refused_by_name(
    lerobot: Path, tmp_path: Path, kept: float | None
) -> None:
    mine = Path(shutil.copytree(lerobot, tmp_path / "mine"))
    damaged = max((mine / "data").rglob("*.parquet"))
    if kept is None:
        damaged.unlink()
    else:
        damaged.write_bytes(damaged.read_bytes()[: int(kept * damaged.stat().st_size)])
    with pytest.raises(DatasetError, match=f"{damaged.name}: not a Parquet file"):
        Exported(mine)


def test_an_export_that_lacks_part_of_a_trial_is_refused_by_its_number(lerobot: Path, tmp_path: Path) -> None:
    mine = Path(shutil.copytree(lerobot, tmp_path / "mine"))
    kept = json.loads((mine / TRIALS).read_text())
    del kept["trials"][0]["x_mm"]
    (mine / TRIALS).write_text(json.dumps(kept))
    frames = max((mine / "data").rglob("*.parquet"))
    pq.write_table(pq.read_table(frames).slice(5), frames)
    with pytest.raises(DatasetError, match="trial 0 lacks 'x_mm'"):
        Exported(mine).trial(0)
    for read in (Exported(mine).trial, lambda index: Exported(mine).frames(index, 0, 8)):
        with pytest.raises(DatasetError, match=rf"{frames.name}: trial 1 cannot be read: 25 frames, expected 30"):
            read(1)
    (mine / TRIALS).write_text(json.dumps(kept | {"trials": kept["trials"][:1]}))
    with pytest.raises(DatasetError, match=r"1 trials in .*, 2 in meta/episodes"):
        Exported(mine)


@pytest.mark.parametrize("drawn", ["", "{}"])
def test_an_export_of_steps_of_depth_says_that_its_timestamps_are_nominal(tmp_path: Path, capsys, drawn: str) -> None:
    folder = made_up_dataset(tmp_path / "cells", [made_up_trial(0, drawn=drawn)], 1)
    assert export_dataset([str(folder), "--out", str(tmp_path / "out")]) == 0
    assert ("steps of depth" in capsys.readouterr().out) == bool(drawn)


def test_nothing_is_overwritten_and_nothing_is_made_up(source: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(DatasetError, match="not empty"):
        export_dataset([str(source), "--out", str(tmp_path)])
    with pytest.raises(DatasetError, match="no trials from number 99"):
        export_dataset([str(source), "--out", str(tmp_path / "new"), "--first", "99"])
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]
