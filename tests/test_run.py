"""The whole loop in real time: cell, service and robot client as processes, with the shipped networks."""

import json
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.waiting import wait_for

ROOT = Path(__file__).parent.parent
MODELS = ROOT / "models"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(600),
    pytest.mark.skipif(not list(MODELS.glob("*.onnx")), reason="no released models in models/"),
]


def run(tmp_path, *arguments):
    command = [sys.executable, "-m", "simulation", "run", "--out", str(tmp_path), *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=560, check=False)


def test_the_rectangle_is_inserted_through_the_real_protocols(tmp_path):
    done = run(tmp_path, "--x-mm", "8", "--theta-deg", "6", "--json")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "INSERTED after" in done.stderr
    (result,) = tmp_path.glob("*/result.json")
    (facts,) = json.loads(done.stdout)
    assert facts == json.loads(result.read_text())
    assert facts["inserted"]
    assert facts["grasp_kept"]
    assert abs(facts["final_x_mm"]) < 4.0
    assert "moves a real robot" not in done.stderr
    assert done.stderr.index("page: http://127.0.0.1:") < done.stderr.index("starting the simulated cell")
    film = Path(re.search(r"film +(\S+)", done.stderr)[1])
    assert film.read_bytes()[:6] == b"GIF89a"
    picture = Path(re.search(r"picture +(\S+)", done.stderr)[1])
    assert picture.stat().st_size > 20_000


def test_the_demonstration_inserts_one_object_after_another_and_its_cell_knows_that_they_are_in(tmp_path):
    (tmp_path / "chosen.toml").write_text("[ramps.travel]\nspeed_mm_s = 60.0\n")
    options = ["--parts", "2", "--port", "0", "--client", str(tmp_path / "chosen.toml")]
    command = [sys.executable, "-m", "simulation", "demo", "--out", str(tmp_path), *options]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=560, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.rstrip().endswith("2 inserted")
    (written,) = tmp_path.glob("*/client.toml")
    assert "[ramps.travel]\nspeed_mm_s = 60.0\n" in written.read_text()
    (listed,) = tmp_path.glob("*/recordings")
    ended = [json.loads(path.read_text()) for path in listed.glob("*/summary.json")]
    outcomes = [summary["outcome"] for summary in ended]
    assert outcomes.count("inserted") == 2  # what was regrasped has one of its own for each time
    assert all(summary["simulated"] for summary in ended)


def test_nothing_is_left_running_after_an_interrupt(tmp_path):
    command = [sys.executable, "-m", "simulation", "run", "--out", str(tmp_path)]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        for line in process.stdout:
            if "approaching" in line:
                break
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 130
    finally:
        process.kill()
        process.stdout.close()
    wait_for(lambda: str(tmp_path) not in subprocess.check_output(["ps", "-eo", "args"], text=True))
