"""Faults in the middle of the live loop: three real processes, a fault during the descent, and the arm must hold.

The networks are tiny ones of the service's tests: what is decided does not matter here.
"""

import json
import time

import httpx
import pytest

from simulation.cell import run

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]

# fault, seconds until the arm must stand still for good
FAULTS = {
    "EGM stream silent": ({"egm": {"silent": True}}, 1.5),
    "EGM stream frozen": ({"egm": {"frozen": True}}, 1.5),
    "guide not heard": ({"egm": {"ignore_guide": True}}, 1.5),
    "EGM datagrams late": ({"egm": {"delay_ms": 600.0}}, 2.0),
    "protective stop": ({"robot": {"protective_stop": True}}, 0.5),
    "emergency stop": ({"robot": {"emergency_stop": True}}, 0.5),
    "motors off": ({"robot": {"motors_off": True}}, 0.5),
    "manual mode": ({"robot": {"mode": "MANR"}}, 0.5),
    "part lost": ({"gripper": {"part_lost": True}}, 1.0),
    "gripper fast stop": ({"gripper": {"fast_stop": True}}, 1.0),
    "gripper connection cut": ({"wsg": {"reset_now": True}}, 1.0),
    "gripper silent": ({"wsg": {"silent": True}}, 2.5),
    "camera stalls": ({"camera_left": {"stall": True}}, 2.0),
    "camera disconnects": ({"camera_right": {"disconnect": True}}, 2.0),
    "camera changes its size": ({"camera_left": {"half_size": True}}, 2.0),
    "camera repeats a frame": ({"camera_left": {"duplicate": True}}, 2.0),
    "camera sends garbage": ({"camera_right": {"garbage_next": 1000}}, 2.0),
    "camera goes black": ({"camera_left": {"black": True}}, 2.0),
}


@pytest.fixture
def loop(tmp_path, models_folder):
    """Cell, service and client up to the beginning of the first descent."""
    options = run.RunOptions(models=models_folder, out=tmp_path)
    start = run.Start("rectangle", 8.0, 6.0, 0)
    with run.loop(start, options, tmp_path / "run") as processes:
        yield processes


def truth(admin_url):
    return httpx.get(f"{admin_url}/truth").json()


def wait_for_descent(loop):
    end = time.monotonic() + 60.0
    while truth(loop.facts["admin_url"])["tcp"]["position_mm"][2] > 34.0:
        loop.client.check()
        assert time.monotonic() < end, loop.client.tail()
        time.sleep(0.02)


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_during_the_descent_ends_in_a_hold(loop, name):
    fault, bound_s = FAULTS[name]
    wait_for_descent(loop)
    httpx.post(f"{loop.facts['admin_url']}/faults", json=fault).raise_for_status()
    time.sleep(bound_s)
    held = truth(loop.facts["admin_url"])
    list(loop.client.lines((), 60.0))
    after = truth(loop.facts["admin_url"])
    assert loop.client.code == 1, loop.client.tail()
    assert "HOLD" in loop.client.log.read_text()
    assert not after["moving"]
    assert after["tcp"]["position_mm"] == pytest.approx(held["tcp"]["position_mm"], abs=0.05)
    end = [json.loads(line) for line in loop.episode.read_text().splitlines()][-1]["end"]
    assert not end["inserted"]
    assert end["reason"]
