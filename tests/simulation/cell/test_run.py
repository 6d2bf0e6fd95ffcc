"""The run's own parts: starts, children, report. The loop itself is in tests/test_run.py."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from simulation.__main__ import main
from simulation.cell import plant, run, run_report
from simulation.cell.children import Child, ChildError
from simulation.cell.options import CellOptions, warn_of_keys_without_effect
from simulation.scene.worlds import load_scene, training_objects
from tests.waiting import wait_for


@pytest.mark.parametrize("name", training_objects())
def test_a_drawn_start_collides_and_repeats(name):
    scene = load_scene(name)
    for seed in range(20):
        x_mm, theta_deg = run.draw_start(scene, seed)
        assert not scene.fits(x_mm, theta_deg)
        assert abs(x_mm) <= scene.x_range_mm
        assert abs(theta_deg) <= scene.theta_range_deg
        assert run.draw_start(scene, seed) == (x_mm, theta_deg)


def test_a_stated_start_is_kept(models_folder):
    start = run.start_of(run.RunOptions(x_mm=8.0, theta_deg=6.0, models=models_folder))
    assert (start.x_mm, start.theta_deg) == (8.0, 6.0)


def test_a_gap_that_nothing_misses_has_a_start_too(tmp_path, models_folder):
    (tmp_path / "wide.toml").write_text(
        '[object]\nshape = "rectangle"\nsize_x_mm = 60.0\nsize_y_mm = 50.0\n[blocks]\ngap_mm = 200.0\n'
    )
    start = run.start_of(run.RunOptions(object=str(tmp_path / "wide.toml"), models=models_folder))
    assert abs(start.x_mm) <= 15.0


def test_blocks_are_free_unless_the_object_or_the_world_fixes_them(tmp_path):
    (tmp_path / "fixed.toml").write_text("[blocks]\nfree = false\n")
    (tmp_path / "box.toml").write_text(
        '[object]\nshape = "rectangle"\nsize_x_mm = 60.0\nsize_y_mm = 50.0\n[blocks]\nfree = false\n'
    )
    assert plant.load(CellOptions()).blocks.free
    assert not plant.load(CellOptions(world=str(tmp_path / "fixed.toml"))).blocks.free
    assert not plant.load(CellOptions(object=str(tmp_path / "box.toml"))).blocks.free


def test_keys_that_only_lock_step_plays_are_named(tmp_path, capsys):
    (tmp_path / "odd.toml").write_text(
        "[camera]\nlatency_ms = 50\nnoise_grey = 3.0\n[motion]\ndescent_speed_mm_s = 5\n"
        "[world]\nswapped_fingers = true\nx_sign = 1\n"
    )
    warn_of_keys_without_effect(str(tmp_path / "odd.toml"), "circle")
    shown = capsys.readouterr().err
    assert "real time: camera.latency_ms, motion.descent_speed_mm_s, world.swapped_fingers; `evaluate` plays" in shown
    warn_of_keys_without_effect(None, "circle")
    assert not capsys.readouterr().err
    (tmp_path / "slow.toml").write_text(
        '[object]\nshape = "rectangle"\nsize_x_mm = 60.0\nsize_y_mm = 50.0\n[motion]\ndescent_speed_mm_s = 5.0\n'
    )
    warn_of_keys_without_effect(None, str(tmp_path / "slow.toml"))
    assert "slow.toml: without effect in real time: motion.descent_speed_mm_s; `evaluate`" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments",
    [["--object", "rectangl"], ["--world", "/none.toml"], ["--models", "/none"]],
)
def test_wrong_input_is_one_line_and_exit_2(arguments, capsys):
    assert main(["run", *arguments]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.fixture
def script(tmp_path, monkeypatch):
    """Write a module and make a child of it."""
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))

    def make(text: str) -> Child:
        (tmp_path / "childscript.py").write_text(text)
        return Child("the child", "childscript", [], tmp_path / "child.log")

    return make


def test_a_child_that_fails_shows_its_last_lines(script):
    with script("print('why it failed'); raise SystemExit(2)") as child, pytest.raises(ChildError) as raised:
        child.until("ready", 10.0)
    assert "why it failed" in str(raised.value)
    assert raised.value.code == 2


def test_a_silent_child_is_given_up(script):
    with (
        script("import time; time.sleep(60)") as child,
        pytest.raises(ChildError, match=r"not ready within 0 s"),
    ):
        child.until("ready", 0.3)
    assert child.code is not None


def test_a_child_that_ignores_the_request_is_killed(script):
    text = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('ready'); time.sleep(60)"
    with script(text) as child:
        assert child.until("ready", 10.0) == "ready"
        begin = time.monotonic()
        child.end(patience_s=0.3)
    assert child.code == -signal.SIGKILL
    assert time.monotonic() - begin < 5.0


def test_a_child_ends_with_a_run_that_is_killed(tmp_path):
    (tmp_path / "childscript.py").write_text("import time; print('ready'); time.sleep(60)")
    run = f"""if True:
        from pathlib import Path
        from simulation.cell.children import Child
        child = Child("the child", "childscript", [], Path({str(tmp_path / "child.log")!r}))
        child.until("ready", 20.0)
        print(child.process.pid, flush=True)
        child.process.wait()
    """
    path = os.pathsep.join([str(tmp_path), *sys.path])
    env = os.environ | {"PYTHONPATH": path}
    with subprocess.Popen([sys.executable, "-c", run], stdout=subprocess.PIPE, text=True, env=env) as killed:
        child = Path(f"/proc/{int(killed.stdout.readline())}/stat")
        assert child.exists()
        killed.kill()
    wait_for(lambda: not child.exists() or child.read_text().split()[2] == "Z")


def test_lines_of_a_child_come_as_they_are_written(script):
    with script("print('one'); print('two')") as child:
        assert list(child.lines((), 10.0)) == ["one", "two"]


def test_the_report_puts_log_and_truth_together(tmp_path):
    log = tmp_path / "episode.jsonl"
    slip = {"type": "slip", "attempt": 1, "captured_ns": 1_000_000_000}
    lines = [{"plan": {}}, {"event": {"kind": "service", "message": slip}}, {"end": {"inserted": True, "attempts": 2}}]
    log.write_text("\n".join(json.dumps(line) for line in lines))
    stop = {"frozen_ns": 1_030_000_000, "rest_ns": 1_080_000_000, "overtravel_mm": 0.2}
    truth = {
        "object": {"x_mm": 0.5, "theta_deg": -1.0, "bottom_z_mm": -20.0, "inserted": True, "in_hand": [0.0] * 6},
        "course": {"max_block_shift_mm": 0.1, "max_block_tilt_deg": 0.0, "max_force_n": 9.0},
        "gripper": {"held": True},
        "stops": [stop],
    }
    result = run_report.collect(truth, log, object_name="rectangle", x_mm=8.0, theta_deg=6.0, seed=0, seconds=12.0)
    assert result.inserted
    assert result.frozen_ms == (30.0,)
    assert result.rest_ms == (80.0,)
    text = "\n".join(run_report.screen(result, None, None, Path("x")))
    assert "INSERTED after 2 attempts" in text
    assert "overtravel 0.20 mm" in text


def test_a_claim_that_is_not_true_says_what_speaks_against_it(tmp_path):
    log = tmp_path / "episode.jsonl"
    log.write_text(json.dumps({"end": {"inserted": True, "attempts": 2}}))
    truth = {
        "object": {"inserted": False, "shortfalls": ["it is tilted by 2.2 deg, below 2 counts"]},
        "course": {"max_block_shift_mm": 0.1, "max_block_tilt_deg": 0.0, "max_force_n": 9.0},
        "gripper": {"held": True},
        "stops": [],
    }
    result = run_report.collect(truth, log, object_name="rectangle", x_mm=8.0, theta_deg=6.0, seed=0, seconds=12.0)
    text = "\n".join(run_report.screen(result, None, None, Path("x")))
    assert text.startswith("NOT INSERTED")
    assert "the client claims an insertion, but it is tilted by 2.2 deg" in text


def test_the_last_decided_attempt_is_drawn(tmp_path):
    frames = np.zeros((8, 2, 320, 327, 3), np.uint8)
    decision = {
        "estimate": {"dx_mm": 1.0, "dtheta_deg": 2.0},
        "dx_mm": -0.7,
        "dtheta_deg": -1.4,
        "class_probabilities": {},
    }
    arrays = {"frames": frames, "displacement_px": np.zeros((2, 20, 21, 2), np.float32)}
    arrays["rest_px"] = arrays["displacement_px"]
    np.savez(tmp_path / "attempt_02.npz", valid=np.ones((2, 20, 21), bool), decision=json.dumps(decision), **arrays)
    truth = {
        "course": {"max_block_shift_mm": 0.0, "max_block_tilt_deg": 0.0, "max_force_n": 0.0},
        "gripper": {"held": True},
        "stops": [],
    }
    result = run_report.collect(truth, tmp_path / "no", object_name="o", x_mm=0.0, theta_deg=0.0, seed=0, seconds=1.0)
    drawn = run_report.draw_last_attempt(tmp_path, tmp_path / "p.png", result)
    assert drawn is not None
    assert drawn.stat().st_size > 10_000
    assert run_report.draw_last_attempt(tmp_path / "none", tmp_path / "q.png", result) is None
