"""A new object is one TOML file: collected, probed, played and reported like those that are known."""

import json

import pytest

from simulation.__main__ import main
from simulation.data.dataset import Dataset

BOX = """
[object]
shape = "rectangle"
size_x_mm = 60.0
size_y_mm = 90.0
texture = "label"
"""
WEAK = "[gel]\nfriction = 0.6\n[grasp]\nforce_n = 15.0\n[world]\ntold_gap_error_mm = 1.0\nstop_lag_s = 0.05\n"
UNKNOWN = "swapped_finger: unknown key; did you mean 'swapped_fingers'? (given: True)"
ROW_KEYS = {
    *("world", "object", "insertions", "inserted", "claimed_wrongly", "refused", "void", "mean_trials"),
    *("direction_right", "direction_n", "mae_x_mm", "mae_theta_deg", "covered_x", "covered_theta"),
    *("worst_force_n", "worst_block_mm", "reasons"),
}


@pytest.fixture
def box(tmp_path):
    path = tmp_path / "box.toml"
    path.write_text(BOX)
    return path


def test_it_is_collected_and_probed(box, tmp_path, capsys):
    out = tmp_path / "data"
    size = ["--trials-per-object", "1", "--trials-per-shard", "1", "--workers", "1"]
    assert main(["collect", "--objects", str(box), "--out", str(out), *size]) == 0
    dataset = Dataset(out)
    assert {dataset.trial(index).object_name for index in range(len(dataset))} == {"box"}
    assert main(["probe", str(box)]) == 0
    assert "outcome blocked" in capsys.readouterr().out


@pytest.mark.slow
def test_every_world_is_played_with_every_object_and_continued(box, models_folder, tmp_path, capsys):
    world = tmp_path / "weak.toml"
    world.write_text(WEAK)
    out = tmp_path / "rows.json"
    ask = ["evaluate", "--worlds", str(world), "--objects", str(box), "circle", "--models", str(models_folder)]
    ask += ["--perception", "fields", "--seed", "3", "-j", "1", "--json", str(out), "--controller", "oracle"]
    assert main([*ask, "--count", "1"]) == 0
    rows = json.loads(out.read_text())
    assert [(row["world"], row["object"]) for row in rows] == [("weak", "box"), ("weak", "circle")]
    assert all(row.keys() == ROW_KEYS for row in rows)
    log = out.with_suffix(".insertions.jsonl")
    before = log.read_text()
    assert main([*ask, "--count", "2"]) == 0
    assert log.read_text().startswith(before)
    assert log.read_text().count("\n") == 4
    assert all(row["insertions"] == 2 for row in json.loads(out.read_text()))
    played = json.loads(before.splitlines()[0])
    assert played["unstated"] == {"told_gap_error_mm": 1.0, "stop_lag_s": 0.05}
    assert played["changes"] == {"gel.friction": 0.6, "grasp.force_n": 15.0}


def test_a_world_that_cannot_be_played_is_one_line_and_nothing_is_written(box, models_folder, tmp_path, capsys):
    world = tmp_path / "swapped.toml"
    world.write_text("[world]\nswapped_finger = true\n")
    out = tmp_path / "new" / "rows.json"
    ask = ["evaluate", "--worlds", str(world), "--objects", str(box), "--models", str(models_folder)]
    assert main([*ask, "--json", str(out)]) == 2
    assert capsys.readouterr().err == f"evaluate: {world}: world.{UNKNOWN}\n"
    assert not out.parent.exists()
