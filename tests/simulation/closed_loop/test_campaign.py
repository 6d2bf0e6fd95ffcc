import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from reporting.files import read_rows
from simulation.cli import evaluate
from simulation.closed_loop import campaign
from tests.simulation.closed_loop.test_evaluation import ROW

ROOT = Path(__file__).parents[3]


def arguments(models, rows, count=2, controller="belief"):
    given = ["--objects", "circle", "--count", str(count), "-j", "1", "--perception", "fields"]
    return [*given, "--json", str(rows), "--models", str(models), "--controller", controller]


def test_an_unknown_name_or_models_folder_is_named(models_folder, tmp_path):
    with pytest.raises(ValueError, match="teapot"):
        evaluate.main(["--objects", "teapot", "--models", str(models_folder)])
    with pytest.raises(ValueError, match="nowhere"):
        evaluate.main(["--models", "nowhere"])
    with pytest.raises(SystemExit):
        evaluate.main(["--controller", "psychic"])


def test_a_finished_run_is_not_played_again(models_folder, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(campaign, "play", lambda _: pytest.fail("played again"))
    options = evaluate.Options(
        objects=("circle",), count=2, models=models_folder, perception="fields", uncommissioned=True
    )
    done = [dict(ROW) | dict(task.job) | {"attempts": 1, "made_by": task.made_by} for task in evaluate.tasks(options)]
    log = tmp_path / "rows.insertions.jsonl"
    log.write_text("\n".join(json.dumps(row) for row in done) + '\n{"cut by a ki')
    assert evaluate.main([*arguments(models_folder, tmp_path / "rows.json"), "--uncommissioned"]) == 0
    assert "circle: 2/2 inserted, mean trials 1.00 (simulated; the paper's real robot: 2.97)" in capsys.readouterr().out


def test_results_of_other_networks_are_not_mixed_in(models_folder, tmp_path):
    setup = campaign.fingerprint({"belief": models_folder})
    assert "belief/direction.step.onnx" in setup
    campaign.claim(tmp_path, setup)
    campaign.claim(tmp_path, setup)
    with pytest.raises(ValueError, match=r"direction\.step\.onnx"):
        campaign.claim(tmp_path, {**setup, "belief/direction.step.onnx": "0" * 64})


@pytest.mark.parametrize("kept", [{campaign.PLAYED_BY: "0" * 64}, {"service.decision.belief": "0" * 64}])
def test_results_of_other_physics_are_not_mixed_in(models_folder, tmp_path, kept):
    (tmp_path / "setup.json").write_text(json.dumps(kept))
    with pytest.raises(ValueError, match="holds results of other code of the simulator"):
        campaign.claim(tmp_path, campaign.fingerprint({"belief": models_folder}))


@pytest.mark.parametrize("text", ["{", "[1]"])
def test_a_folder_that_does_not_say_what_made_it_is_refused_by_name(tmp_path, text):
    (tmp_path / "setup.json").write_text(text)
    with pytest.raises(ValueError, match=r"setup\.json does not say what"):
        campaign.claim(tmp_path, {})


def test_a_disturbance_that_was_changed_is_played_again_and_nothing_counts_twice(tmp_path, monkeypatch):
    job = {
        "condition": "bristle: clearance",
        "scene": "circle",
        "controller": "belief",
        "perception": "fields",
        "seed": 1,
        "index": 0,
    }
    was, now = ({**job, "changes": {"blocks.gap_mm": gap}} for gap in (53.0, 54.0))
    (tmp_path / "log").write_text(json.dumps(was | {"attempts": 1}) + "\n")
    monkeypatch.setattr(campaign, "play", lambda task: dict(task.job) | {"attempts": 2})
    tasks = [campaign.Task(tmp_path, now), campaign.Task(tmp_path, now)]
    for _ in range(2):
        assert campaign.run(tasks, tmp_path / "log", workers=1) == [now | {"attempts": 2}]
    assert len(read_rows(tmp_path / "log")) == 2


def test_two_processes_do_not_play_the_same_insertions_into_one_log(tmp_path, monkeypatch):
    tasks = [campaign.Task(tmp_path, {"scene": "circle", "seed": 1})]

    def play(task):
        with pytest.raises(ValueError, match="log: another process adds rows to it"):
            campaign.run(tasks, tmp_path / "log", workers=1)
        return dict(task.job)

    monkeypatch.setattr(campaign, "play", play)
    for _ in range(2):
        assert campaign.run(tasks, tmp_path / "log", workers=1) == [dict(tasks[0].job)]
    assert len(read_rows(tmp_path / "log")) == 1


@pytest.mark.slow
def test_a_killed_run_goes_on_where_it_was(models_folder, tmp_path):
    rows = tmp_path / "rows.json"
    command = [sys.executable, "-m", "simulation", "evaluate", *arguments(models_folder, rows, 40, "oracle")]
    log = tmp_path / "rows.insertions.jsonl"
    with subprocess.Popen(command, cwd=ROOT, start_new_session=True, stderr=subprocess.DEVNULL) as first:
        deadline = time.monotonic() + 90.0
        while first.poll() is None and time.monotonic() < deadline:
            if log.exists() and log.read_bytes().count(b"\n") >= 2:
                break
            time.sleep(0.02)
        os.killpg(first.pid, signal.SIGKILL)
    before = read_rows(log)
    assert 2 <= len(before) < 40
    assert evaluate.main(arguments(models_folder, rows, 3, "oracle")) == 0
    after = read_rows(log)
    keys = [campaign.key_of(row) for row in after]
    assert len(keys) == len(set(keys)) >= 3
    assert after[: len(before)] == before
