import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from simulation.cli import evaluate
from simulation.cli import robustness as robustness_command
from simulation.closed_loop import campaign, robustness
from simulation.scene.worlds import load_objects, load_scene, object_names
from tests.service import tiny_models
from tests.simulation.closed_loop.test_evaluation import ROW

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    return tiny_models.write_models(tmp_path_factory.mktemp("models") / "tiny")


def arguments(models, out, count=2, controllers=("belief",)):
    given = [
        "--objects",
        "circle",
        "--count",
        str(count),
        "--baseline-count",
        str(count),
        "-j",
        "1",
        "--perception",
        "fields",
    ]
    return [
        *given,
        "--out",
        str(out),
        "--docs",
        str(out / "docs"),
        "--models",
        str(models),
        "--controllers",
        *controllers,
    ]


def test_an_unknown_name_or_models_folder_is_named(models, tmp_path):
    with pytest.raises(ValueError, match="teapot"):
        evaluate.main(["--objects", "teapot", "--out", str(tmp_path)])
    with pytest.raises(ValueError, match="nowhere"):
        evaluate.main(["--models", "nowhere", "--out", str(tmp_path)])
    with pytest.raises(ValueError, match="psychic"):
        evaluate.main(["--controllers", "psychic", "--out", str(tmp_path)])
    with pytest.raises(ValueError, match="earthquake"):
        robustness_command.main(["--only", "earthquake", "--models", str(models), "--out", str(tmp_path)])


def test_a_finished_run_is_not_played_again(models, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(campaign, "play", lambda _: pytest.fail("played again"))
    options = evaluate.Options(objects=("circle",), count=2, models=models, perception="fields")
    done = [
        dict(ROW) | dict(task.job) | {"attempts": 1}
        for task in evaluate.tasks(options, ("belief",), load_objects(options.objects))
    ]
    log = tmp_path / "insertions.jsonl"
    log.write_text("\n".join(json.dumps(row) for row in done) + '\n{"cut by a ki')
    assert evaluate.main(arguments(models, tmp_path)) == 0
    assert "| 2/2 | 100.0 % (" in capsys.readouterr().out
    assert (tmp_path / "docs" / "closed_loop_trials.png").stat().st_size > 1000


def test_results_of_other_networks_are_not_mixed_in(models, tmp_path):
    setup = campaign.fingerprint({"belief": models})
    assert "belief/direction.step.onnx" in setup
    campaign.claim(tmp_path, setup)
    campaign.claim(tmp_path, setup)
    with pytest.raises(ValueError, match=r"direction\.step\.onnx"):
        campaign.claim(tmp_path, {**setup, "belief/direction.step.onnx": "0" * 64})


@pytest.mark.parametrize("kept", [{campaign.PLAYED_BY: "0" * 64}, {"service.decision.belief": "0" * 64}])
def test_results_of_other_physics_are_not_mixed_in(models, tmp_path, kept):
    (tmp_path / "setup.json").write_text(json.dumps(kept))
    with pytest.raises(ValueError, match="holds results of other code of the simulator"):
        campaign.claim(tmp_path, campaign.fingerprint({"belief": models}))


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
    assert len(campaign.read_log(tmp_path / "log")) == 2


def test_a_row_without_networks_is_left_out(models):
    options = evaluate.Options(models=models, paper_models=models / "none", controllers=("belief", "paper", "joint"))
    assert evaluate.entered(options) == ("belief",)


@pytest.mark.slow
def test_a_killed_run_goes_on_where_it_was(models, tmp_path):
    command = [sys.executable, "-m", "simulation", "evaluate", *arguments(models, tmp_path, 40, ("oracle",))]
    log = tmp_path / "insertions.jsonl"
    with subprocess.Popen(command, cwd=ROOT, start_new_session=True, stderr=subprocess.DEVNULL) as first:
        deadline = time.monotonic() + 90.0
        while first.poll() is None and time.monotonic() < deadline:
            if log.exists() and log.read_bytes().count(b"\n") >= 2:
                break
            time.sleep(0.02)
        os.killpg(first.pid, signal.SIGKILL)
    before = campaign.read_log(log)
    assert 2 <= len(before) < 40
    assert evaluate.main(arguments(models, tmp_path, 3, ("oracle",))) == 0
    after = campaign.read_log(log)
    keys = [campaign.key_of(row) for row in after]
    assert len(keys) == len(set(keys)) >= 3
    assert after[: len(before)] == before


@pytest.mark.parametrize("scene", object_names())
def test_every_disturbance_makes_a_possible_scene(scene):
    cell = load_scene(scene, blocks__free=True)
    for name, condition in robustness.CONDITIONS.items():
        disturbed = cell.varied(condition.changes(cell))
        assert (disturbed == cell) == (not condition.changes(cell)), name


def test_a_disturbance_that_only_pictures_show_is_played_with_pictures(models):
    options = robustness_command.Options(models=models, objects=("circle",), count=1, perception="fields")
    played = {
        task.job["condition"].split(": ")[1]: task.job["perception"] for task in robustness_command.tasks(options)
    }
    assert {name for name, perception in played.items() if perception == "pictures"} == {
        "gel worn out",
        "left camera dark",
        "left camera frozen",
    }


def page_of(rows):
    return robustness.robustness_page(robustness.report_of(rows, {}))


def test_the_robustness_report_names_its_perception():
    rows = [ROW | {"condition": robustness.label("bristle", name)} for name in robustness.CONDITIONS]
    text = page_of([row | {"perception": "pictures" if "gel" in row["condition"] else "fields"} for row in rows])
    assert "true marker field" in text
    assert "drawn: gel friction x 0.7, gel friction x 1.4" in text


def test_the_robustness_table_has_a_row_a_tier():
    rows = [
        ROW | {"condition": robustness.label(tier, name)}
        for tier in ("bristle", "layer")
        for name in robustness.CONDITIONS
    ]
    text = page_of(rows)
    assert text.count("| bristle | 1/1 |") == text.count("| layer | 1/1 |") == len(robustness.CONDITIONS)


def test_an_insertion_without_an_equilibrium_is_not_said_to_be_refused():
    failed = ROW | {"condition": robustness.label("bristle", "block friction x 2"), "inserted": False, "claimed": False}
    text = page_of([failed | {"attempts": 2, "void": True}, failed | {"attempts": 1}])
    assert "| 0/2 | 0 % (0 .. 66) | 16.00 | 1 | 0 | 1 |" in text
