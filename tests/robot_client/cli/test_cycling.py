"""`cycle` as an operator starts it: what it prints where something goes wrong, and its orders from the terminal."""

import asyncio
import os
import pty
import subprocess
import sys
from pathlib import Path

import pytest

from robot_client.cli.cycle import _cycle
from robot_client.cli.insert import make_plan
from robot_client.cli.main import main
from robot_client.session.recorder import Recorder
from tests.robot_client.cycle_cell import cell_with

SHELL = """
import fcntl, subprocess, sys, termios, time
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
subprocess.Popen([sys.executable, "-c", sys.argv[1]], process_group=0)
time.sleep(30.0)
"""
IN_THE_BACKGROUND = """
import asyncio
from robot_client.cli.cycle import _take_orders
from robot_client.session.cycle import Pace
async def story():
    _take_orders(Pace())
    for _ in range(200):
        print("goes on", flush=True)
        await asyncio.sleep(0.05)
asyncio.run(story())
"""


def test_in_the_background_of_a_shell_in_which_somebody_types_it_goes_on():
    master, slave = pty.openpty()
    arguments = [sys.executable, "-c", SHELL, IN_THE_BACKGROUND]
    with subprocess.Popen(arguments, stdin=slave, stdout=slave, stderr=slave, start_new_session=True) as shell:
        os.close(slave)
        printed = b""
        while b"goes on" not in printed:
            printed += os.read(master, 4096)
        os.write(master, b"ls\n")
        printed = b""
        while printed.count(b"goes on") < 8:
            printed += os.read(master, 4096)
        assert b"Traceback" not in printed
        shell.kill()
    os.close(master)


def test_a_part_that_is_not_there_is_named_with_the_controllers_answer_and_a_lost_log(tmp_path, capsys, monkeypatch):
    def full(self, _line):
        self.lost = "No space left on device"

    monkeypatch.setattr(Recorder, "_write", full)

    async def story():
        async with cell_with() as (cell, part):
            part.is_there = lambda: False
            plan = make_plan(cell.settings, 0.0, 0.0, None, None)
            return await _cycle(cell.settings, cell.settings.cycle, 1, Path(tmp_path), plan)

    outcome = asyncio.run(asyncio.wait_for(story(), 60.0))
    lines = capsys.readouterr().out
    assert not outcome.done
    assert "on nothing; is the object between the fingers?" in outcome.result["reason"]
    assert "robot: controller confirms: program stopped" in lines
    (log,) = tmp_path.iterdir()
    assert f"insertion {log.stem}\n" in lines, "the name of its recording, and of its lines in the service's log"
    assert "BROKEN OFF: No space left on device" in lines


@pytest.mark.parametrize("command", ["cycle", "commission"])
@pytest.mark.parametrize("mode", ["--live", "--dry-run"])
@pytest.mark.parametrize(
    ("toml", "expect"),
    [
        ("[task]\nexpected_depth_mm = 60.0", "plan z_mm = -2"),
        ("[task]\napproach_z_mm = 3.5\n", "plan z_mm"),
        ("[ramps.travel]\nspeed_mm_s = 500.0\nacceleration_mm_s2 = 1.0\njerk_mm_s3 = 1.0", "ramps.travel"),
        ("[lease]\nstop_lag_s = 40.0", "lease"),
    ],
)
def test_nothing_is_picked_for_a_plan_that_would_be_refused(command, mode, toml, expect, tmp_path, capsys):
    """The devices are nowhere: connecting would end with 1, not with 2."""
    path = tmp_path / "cell.toml"
    taught = "[cycle]\nopen_mm = 80\n[cycle.pick]\nx_mm = 0\ny_mm = 0\nz_mm = 45\nyaw_deg = 0"
    nowhere = '[gripper]\nhost = "127.0.0.1"\nport = 1\n[robot]\nrws.url = "http://127.0.0.1:1"'
    path.write_text(f"simulated = true\n{toml}\n{nowhere}\n{taught}\n")
    out = ["--out", str(tmp_path / "record")] if command == "commission" else []
    assert main([command, mode, "--config", str(path), *out]) == 2
    assert expect in capsys.readouterr().err
