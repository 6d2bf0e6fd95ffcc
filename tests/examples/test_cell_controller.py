"""The controller that docs/api.md teaches, against the real service as a process: it stops on every fault."""

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time

import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from simulation.studies.motion_bounds.relay import Relay
from tests.examples.cell import EXAMPLE, SLOW_MM_S, Cell, controller, stands, started
from tests.examples.tiny_arm import TinyArm
from tests.service.mjpeg import FakeFinger


class Proxy(Relay):
    """A link to the service on which somebody may also speak in its name."""

    def inject(self, text: str) -> None:
        client, content = self._writers[-2], text.encode()
        assert len(content) < 126
        self._loop.call_soon_threadsafe(client.write, bytes((0x81, len(content))) + content)


@pytest.fixture(scope="module")
def fingers():
    both = FakeFinger("left"), FakeFinger("right")
    yield both
    for finger in both:
        finger.close()


@pytest.fixture(scope="module")
def shared(tmp_path_factory, models_folder, fingers):
    with started(tmp_path_factory.mktemp("cell"), models_folder, fingers) as service:
        yield Cell(service, fingers)


@pytest.fixture
def cell(shared):
    shared.rest()
    return shared


def test_the_example_needs_nothing_of_ours():
    names = "simulation", "training", "export", "service", "robot_client", "reporting", "tactile_insertion"
    script = f"""
import runpy, sys
runpy.run_path({str(EXAMPLE)!r})
print([m for m in sys.modules if m.split('.')[0] in {names!r}], 'websockets' in sys.modules)
"""
    done = subprocess.run([sys.executable, "-I", "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[] True"


def corrected(cell, speed_mm_s: float) -> tuple[TinyArm, dict]:
    """An insertion with one touch, and its arm. If a busy machine stops it late, it is held and repeated slower."""
    arm = TinyArm(touch=cell.touch)
    retract = arm.retract

    def retract_and_rest():
        retract()
        for finger in cell.fingers:
            finger.probe_started = None

    arm.retract = retract_and_rest
    try:
        return arm, cell.insert(arm, depth_mm=2.5, speed_mm_s=speed_mm_s, neighbours_stay=True)
    except controller.Held:
        if speed_mm_s < 0.2 * SLOW_MM_S:
            raise
    cell.rest()
    return corrected(cell, speed_mm_s / 2)


def test_it_stops_on_touch_corrects_once_and_inserts(cell):
    arm, finished = corrected(cell, 0.5 * SLOW_MM_S)
    assert (finished["type"], finished["outcome"]) == ("finished", "inserted")
    assert arm.grasped == 1
    assert len(arm.moves) == finished["attempts"] - 1 >= 1
    assert arm.depth_mm() == 2.5


def camera(trouble):
    def cause(cell, _):
        cell.fingers[1].trouble = trouble

    return cause


def stop_service(cell, _):
    os.kill(cell.service.process.pid, signal.SIGSTOP)
    threading.Timer(2.0, os.kill, (cell.service.process.pid, signal.SIGCONT)).start()


def stop_ourselves(_cell, _proxy):
    """The controller's own process stands still for a second; what ends the descent is the arm's watchdog.

    These cameras stand still with it: what the service says of them may be read first.
    """
    ours = os.getpid()
    subprocess.run(["sh", "-c", f"kill -STOP {ours}; sleep 1; kill -CONT {ours}"], check=True)


FREQUENT = {"service stopped", "camera stalled", "link half open", "nonsense"}
FAULTS = {
    "service stopped": (stop_service, "unwatched"),
    "controller stopped": (stop_ourselves, "unwatched|turned_in_hand"),
    "camera stalled": (camera("stalled"), "unwatched|no_reference|turned_in_hand"),
    "camera frozen": (camera("frozen"), "unwatched|no_reference|turned_in_hand"),
    "camera frozen beneath fresh noise": (camera("repeated"), "unwatched|no_reference|turned_in_hand"),
    "camera black": (camera("black"), "unwatched|no_reference|turned_in_hand"),
    "camera late by a second": (camera("late"), "unwatched|no_reference|turned_in_hand"),
    "link half open": (lambda _, proxy: proxy.misbehave("half open"), "unwatched"),
    "link dripping byte by byte": (lambda _, proxy: proxy.misbehave("drip"), "unwatched"),
    "link cut": (lambda _, proxy: proxy.misbehave("reset"), "no close frame"),
    "nonsense": (lambda _, proxy: proxy.inject("nonsense"), "Expecting value"),
    "frame of tomorrow": (
        lambda _, proxy: proxy.inject(
            json.dumps({"type": "watching", "attempt": 1, "frame_captured_ns": time.monotonic_ns() + 86_400 * 10**9})
        ),
        "clocks contradict",
    ),
    "fatal fault": (
        lambda _, proxy: proxy.inject('{"type": "fault", "code": "taken_over", "detail": "hold", "fatal": true}'),
        "taken_over",
    ),
    "finished": (
        lambda _, proxy: proxy.inject('{"type": "finished", "outcome": "failed", "cause": "service", "doubts": []}'),
        "ended failed",
    ),
}


@pytest.mark.parametrize(
    "fault", [name if name in FREQUENT else pytest.param(name, marks=pytest.mark.slow) for name in FAULTS]
)
def test_a_fault_in_mid_descent_stops_the_arm(cell, fault):
    cause, expected = FAULTS[fault]
    proxy = Proxy.to(cell.service.url(""))
    arm = TinyArm(trouble=lambda: cause(cell, proxy))
    try:
        with pytest.raises(Exception) as raised:
            cell.insert(arm, proxy.own_port)
        stands(arm)
        assert re.search(expected, f"{getattr(raised.value, 'cause', '')} {raised.value}")
    finally:
        proxy.close()


def test_a_camera_that_is_lost_is_no_fatal_fault_and_no_licence_to_move(cell):
    """The arm stops, the service decides nothing, the same spot is probed, and arming is refused without the object."""

    def cut():
        cell.fingers[0].connected = False

    arm = TinyArm(trouble=cut)
    with pytest.raises(controller.Held, match=r"refused|no_reference|turned_in_hand|camera|judged frame"):
        cell.insert(arm)
    stands(arm)


def test_another_client_that_takes_over_ends_the_descent(cell):
    link = []

    def take_over():
        head = {"Authorization": f"Bearer {cell.service.token}"}
        link.append(connect(cell.service.url("/v1/insertion", "ws"), additional_headers=head))
        link[0].send(json.dumps({"type": "hello", "insertion_id": "shared", "client": "second"}))
        link[0].recv(10)

    arm = TinyArm(trouble=take_over)
    with pytest.raises(controller.Held, match="taken_over"):
        cell.insert(arm, name="shared")
    stands(arm)
    link[0].send(json.dumps({"type": "abort", "insertion_id": "shared", "cause": "operator", "reason": "done"}))
    link[0].close()


@pytest.mark.slow
def test_a_wall_clock_that_is_stepped_in_mid_descent_changes_nothing(cell, monkeypatch):
    today = time.time

    def step():
        monkeypatch.setattr(time, "time", lambda: today() + 86_400.0)

    arm = TinyArm(trouble=step)
    finished = cell.insert(arm)
    assert time.time() > today() + 86_000.0, "the clock was stepped"
    assert (finished["outcome"], arm.depth_mm()) == ("inserted", 4.0)


def test_nothing_moves_without_the_token(cell):
    arm = TinyArm()
    with pytest.raises(InvalidStatus):
        cell.insert(arm, token="wrong")
    with pytest.raises(controller.Held, match="forbidden"):
        cell.insert(arm, token="")
    assert not arm.grasped
    assert arm.depth_mm() == 0.0


def test_nothing_moves_in_an_attempt_that_is_refused(cell):
    arm = TinyArm()
    arm.widths_mm = [0.5]
    with pytest.raises(controller.Held, match="implausible_width"):
        cell.insert(arm)
    stands(arm)
    assert arm.depth_mm() == 0.0


def test_an_object_that_has_turned_in_the_hand_is_handed_over_to_a_person_and_gone_on_with(cell):
    proxy, arm = Proxy.to(cell.service.url("")), TinyArm()
    refusal = {"type": "refused", "reason": "turned_in_hand", "detail": "by about 1.4 deg"}
    arm.width_mm = lambda: proxy.inject(json.dumps(refusal))
    try:
        with pytest.raises(controller.Held, match=r"turned_in_hand: .*continues='turning'"):
            cell.insert(arm, proxy.own_port, name="turning")
    finally:
        proxy.close()
    stands(arm)
    assert arm.depth_mm() == 0.0
    assert cell.outcome("turning") == ("failed", "refused")
    again = TinyArm()
    again.refuses = "enough for this test"
    with pytest.raises(RuntimeError):
        cell.insert(again, name="upright", continues="turning")
    assert cell.summary("upright")["continues"] == "turning"


def test_an_arm_that_refuses_is_stopped_and_the_record_says_who_gave_up(cell):
    arm = TinyArm()
    arm.refuses = "motors are off"
    with pytest.raises(RuntimeError, match="motors are off"):
        cell.insert(arm, name="refusing")
    stands(arm)
    assert cell.outcome("refusing") == ("failed", "client")


def test_an_operator_who_interrupts_stops_the_arm(cell):
    arm = TinyArm()

    def interrupted():
        if arm.depth_mm() > 1.0:
            raise KeyboardInterrupt
        return True

    arm.descending = interrupted
    with pytest.raises(KeyboardInterrupt):
        cell.insert(arm, name="interrupted")
    del arm.descending
    stands(arm)
    assert cell.outcome("interrupted") == ("aborted", "operator")


def test_full_depth_without_the_object_is_not_taken_for_an_insertion(cell):
    arm = TinyArm()
    arm.widths_mm = [49.6, 40.0]
    with pytest.raises(controller.Held, match="not_confirmed") as raised:
        cell.insert(arm, depth_mm=2.0)
    assert raised.value.cause == "not_confirmed"
    assert not arm.retracted
    stands(arm)


def test_a_killed_service_stops_the_arm(cell):
    """The last of those that share the service, which is gone then."""
    arm = TinyArm(trouble=cell.service.kill)
    with pytest.raises(Exception, match=r"close frame|reset|refused|judged"):
        cell.insert(arm)
    stands(arm)


@pytest.mark.parametrize("key", ["dx_mm", "dtheta_deg"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), 15.01, -99.0])
def test_a_correction_beyond_the_service_s_own_limits_moves_nothing(key, value):
    with pytest.raises(controller.Held, match=key):
        controller._bounded({key: value}, {"max_dx_mm": 15.0, "max_dtheta_deg": 15.0}, key)
