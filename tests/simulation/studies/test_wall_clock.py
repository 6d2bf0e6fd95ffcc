"""A wall clock that is set in a running process: which clocks it moves, and what a service says afterwards."""

import json
import os
import shutil
import subprocess
import sys
import time
from urllib.request import urlopen

import pytest

from service.recordings.reader import Recording
from simulation.cell.run import RunOptions, Start, loop
from simulation.studies.motion_bounds.faults import FAULTS, HOUR_S, Bench
from simulation.studies.motion_bounds.play import _ended, _inject
from simulation.studies.motion_bounds.relay import Relay
from simulation.studies.motion_bounds.wall_clock import set_ahead, settable

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler on this machine")
CLOCKS = """
import ctypes, datetime, subprocess, sys, time
libc, at = ctypes.CDLL(None), (ctypes.c_long * 2)()
child = [sys.executable, "-c", "import time; print(time.time())"]
for _ in sys.stdin:
    libc.gettimeofday(at, None)
    wall = [time.time(), datetime.datetime.now().timestamp(), libc.time(None), at[0], subprocess.check_output(child)]
    print(*map(float, wall), time.monotonic(), time.perf_counter(), flush=True)
"""


def clocks():
    return subprocess.Popen([sys.executable, "-c", CLOCKS], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def ahead_s(process):
    """How far its clocks, five of the wall and two steady ones, are ahead of those here."""
    process.stdin.write("\n")
    process.stdin.flush()
    theirs = map(float, process.stdout.readline().split())
    here = [*5 * [time.time()], time.monotonic(), time.perf_counter()]
    return [their - our for their, our in zip(theirs, here, strict=True)]


@pytest.mark.parametrize("hour_s", [HOUR_S, -HOUR_S])
def test_only_the_wall_clock_of_one_process_and_its_children_is_set(hour_s):
    before = dict(os.environ)
    with settable(), clocks() as one, clocks() as other:
        assert ahead_s(one) == pytest.approx(7 * [0.0], abs=5.0)
        set_ahead(one.pid, hour_s)
        assert ahead_s(one) == pytest.approx([*5 * [hour_s], 0.0, 0.0], abs=5.0)
        assert ahead_s(other) == pytest.approx(7 * [0.0], abs=5.0)
    assert dict(os.environ) == before, "what starts later is as before"


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize(("way", "hour_s"), [("forward", HOUR_S), ("back", -HOUR_S)])
def test_what_a_service_says_of_an_insertion_is_no_hour_longer_or_shorter_where_its_clock_was_set(
    way, hour_s, tmp_path
):
    fault = next(fault for fault in FAULTS if fault.name == f"service wall clock set {way} by 1 h")
    relays = []

    def through(url):
        relays.append(Relay.to(url))
        return relays[-1].url

    with settable(), loop(Start("rectangle", 8.0, 6.0, 0), RunOptions(), tmp_path / "run", through) as running:
        assert _inject(fault, "air", Bench(running, relays[0]))
        assert _ended(running.client)

        def answered(path):
            with urlopen(f"http://{relays[0].host}:{relays[0].port}{path}", timeout=5.0) as answer:
                return json.load(answer)

        status, (listed,) = answered("/v1/status"), answered("/v1/recordings")["recordings"]
        curves = answered(f"/v1/recordings/{listed['name']}/timeline")
        relays[0].close()
    assert status["now_s"] - time.time() == pytest.approx(hour_s, abs=60.0), "the clock was set"
    assert status["last"]["outcome"] == "inserted"
    assert 5.0 < status["last"]["seconds"] < 60.0
    assert 5.0 < listed["seconds"] < 60.0
    events_s = [event["t"] for event in curves["events"]]
    assert events_s == sorted(events_s)
    assert 0.0 <= events_s[0] <= events_s[-1] < 60.0
    (path,) = (tmp_path / "run" / "recordings").glob("*/insertion.mcap")
    stamps = [entry.log_ns for entry in Recording(path).of("/messages")]
    assert stamps == sorted(stamps)
    assert stamps[-1] - stamps[0] < 60e9
    assert not [log for log in (tmp_path / "run").glob("*.log") if "Traceback" in log.read_text()]
