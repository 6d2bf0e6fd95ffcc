"""Ctrl-C ends every long command within two seconds, with one line and no traceback, and keeps finished work."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from simulation.studies.witness import calculix

ROOT = Path(__file__).parents[1]
pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]
PATIENCE_S = 2.0 * max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))

# What to type, and how long to let it work before the interrupt; OUT is a folder of the test.
COMMANDS = {
    "collect": ("simulation collect --objects rectangle --trials-per-object 4000 --workers 2 --out OUT", 15),
    "evaluate": ("simulation evaluate --perception fields --json OUT/rows.json", 15),
    "evaluate, foreign": ("simulation evaluate --cell foreign --perception fields --json OUT/rows.json", 15),
    "trust": ("simulation trust --count 400 --out OUT", 15),
    "drawn-worlds": ("simulation drawn-worlds --out OUT --docs OUT", 15),
    "sealed": ("simulation sealed --counter 99 --out OUT --docs OUT", 15),
    "commission": ("simulation commission --worlds OUT/world.toml --objects circle --json OUT/rows.json", 15),
    "pace": ("simulation pace --out OUT --docs OUT", 15),
    "motion-bounds": ("simulation motion-bounds --out OUT --runs OUT", 15),
    "run": ("simulation run --out OUT", 12),
    "demo": ("simulation demo --port 0 --out OUT", 12),
    "accuracy": ("simulation accuracy --out OUT", 10),
    "hard-probes": ("simulation hard-probes --out OUT", 10),
    "slip-report": ("simulation slip-report --out OUT", 10),
    "foreign-check": ("simulation foreign-check --out OUT --runs OUT", 10),
    "scene judge": ("simulation scene judge --out OUT", 15),
    "scene fit": ("simulation scene fit --out OUT/posterior.npz", 15),
    "verify": ("export verify models/pressing --stream-steps 10000000", 15),
    "benchmark": ("export benchmark models/pressing/pair.step.onnx --seconds 100 --docs OUT", 10),
}


def interrupted(process: subprocess.Popen, name: str) -> None:
    """Ctrl-C; it must end in time, in one line."""
    began = time.monotonic()
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=60)
    took_s = time.monotonic() - began
    assert "Traceback" not in output, output[-2000:]
    assert output.rstrip().splitlines()[-1].startswith(f"{name}: interrupted"), output[-500:]
    assert process.returncode == 130
    assert took_s < PATIENCE_S


NEEDS = {
    "foreign-check": pytest.mark.skipif(
        not calculix.is_installed(), reason="no CalculiX (apt-get install calculix-ccx)"
    )
}


@pytest.mark.parametrize("name", [pytest.param(name, marks=NEEDS.get(name, ())) for name in COMMANDS])
def test_an_interrupt_ends_it_at_once_in_one_line(name, tmp_path):
    typed, work_s = COMMANDS[name]
    words = typed.replace("OUT", str(tmp_path)).split()
    (tmp_path / "world.toml").write_text("[gel]\nfriction = 0.9\n")
    command = [sys.executable, "-m", *words]
    with subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    ) as process:
        try:
            time.sleep(work_s)
            assert process.poll() is None, f"it ended by itself: {process.stdout.read()[-500:]}"
            interrupted(process, words[1])
        finally:
            process.kill()


RUN = """name = "mine"
runs = "{folder}"
[data]
path = "{folder}/probes"
cache = "{folder}/cache"
[network]
kind = "markers"
trunk_width = 8
feature_size = 16
state_size = 16
[trunk]
epochs = 100000
patience = 100000
"""


def epochs_until_interrupted(run: Path, least_n: int) -> list[int]:
    """Train until the log has so many epochs, interrupt, and return them; the end is as every command's."""
    log = run.parent / "mine" / "log.jsonl"
    command = [sys.executable, "-m", "training", "train", str(run)]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        until_s = time.monotonic() + 300
        while not log.exists() or log.read_text().count("\n") < least_n:
            assert time.monotonic() < until_s
            assert process.poll() is None, process.stdout.read()[-500:]
            time.sleep(0.05)
        interrupted(process, "train")
    finally:
        process.kill()
    return [json.loads(line)["epoch"] for line in log.read_text().splitlines()]


def test_an_interrupted_training_goes_on_where_it_was(tmp_path):
    made = ["--objects", "rectangle", "--trials-per-object", "24", "--trials-per-shard", "12"]
    command = [sys.executable, "-m", "simulation", "collect", *made, "--out", str(tmp_path / "probes")]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    run = tmp_path / "mine.toml"
    run.write_text(RUN.format(folder=tmp_path))
    before = epochs_until_interrupted(run, 2)
    after = epochs_until_interrupted(run, len(before) + 2)
    assert after[: len(before)] == before == list(range(len(before)))
    assert after[len(before)] in {before[-1], before[-1] + 1}, "the epoch that was not saved is trained again"
