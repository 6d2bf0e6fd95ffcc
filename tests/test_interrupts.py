"""Ctrl-C ends every long command within two seconds, with one line and no traceback, and what was done is kept."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]
PATIENCE_S = 2.0 * max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))

# arguments, and how long to let it work before the interrupt
COMMANDS = {
    "collect": (
        ["simulation", "collect", "--objects", "rectangle", "--trials-per-object", "4000", "--workers", "2"],
        15,
    ),
    "trust": (["simulation", "trust", "--count", "400"], 15),
    "run": (["simulation", "run"], 12),
    "demo": (["simulation", "demo", "--port", "0"], 12),
    "accuracy": (["simulation", "accuracy"], 10),
    "hard-probes": (["simulation", "hard-probes"], 10),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_an_interrupt_ends_it_at_once_in_one_line(name, tmp_path):
    words, work_s = COMMANDS[name]
    command = [sys.executable, "-m", *words, "--out", str(tmp_path / "out")]
    (tmp_path / "out").mkdir()
    process = subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    )
    try:
        time.sleep(work_s)
        if process.poll() is not None:
            raise AssertionError(f"it ended by itself: {process.stdout.read()[-500:]}")
        began = time.monotonic()
        process.send_signal(signal.SIGINT)
        output, _ = process.communicate(timeout=60)
        took_s = time.monotonic() - began
    finally:
        process.kill()
    assert "Traceback" not in output, output[-2000:]
    assert output.rstrip().splitlines()[-1].startswith(f"{words[1]}: interrupted"), output[-500:]
    assert process.returncode == 130
    assert took_s < PATIENCE_S
