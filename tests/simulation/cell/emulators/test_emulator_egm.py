"""The robot's side of EGM, over a real UDP socket."""

import re
import socket
import struct
import time
from pathlib import Path

import pytest

from robot_client.robots.abb_egm import codec
from robot_client.robots.abb_egm.settings import Settings
from simulation.cell.emulators.abb.egm import CYCLE_S
from simulation.cell.emulators.net import free_port
from tests.simulation.physics.bench import bench, forever


class Guide:
    """A guide that answers where the datagram came from."""

    def __init__(self, port):
        self.sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.sock.bind(("127.0.0.1", port))
        self.sock.settimeout(20.0)
        self.robot = None
        self.count = 0

    def state(self):
        data, self.robot = self.sock.recvfrom(4096)
        return codec.decode_robot(data)

    def send(self, pose):
        self.count += 1
        self.sock.sendto(codec.encode_guidance(codec.Guidance(self.count, 0, pose)), self.robot)

    def descend(self, speed_mm_s, seconds):
        """Follow the stream with a falling target; the last target sent."""
        start = self.state().feedback
        for k in range(round(seconds / CYCLE_S)):  # by the robot's cycles, whatever the machine does
            pose = codec.Pose(start.x_mm, start.y_mm, start.z_mm - speed_mm_s * k * CYCLE_S, *start.quaternion)
            self.send(pose)
            self.state()
        return pose

    def drain(self):
        self.sock.setblocking(False)
        try:
            while True:
                self.sock.recv(4096)
        except BlockingIOError:
            self.sock.settimeout(20.0)


@pytest.fixture(scope="module")
def made():
    port = free_port(socket.SOCK_DGRAM)
    guide = Guide(port)
    with bench(egm_guide_port=port) as cell:
        yield cell, guide
    guide.sock.close()


@pytest.fixture
def up(made):
    cell, guide = made
    cell.call(cell.cell.board.clear)
    cell.call(cell.cell.cabinet.request_stop)
    cell.wait(lambda: not cell.cell.cabinet.running and cell.cell.cabinet.arm.at_rest)
    time.sleep(0.06)
    guide.drain()
    cell.wait(lambda: cell.cell.cabinet.state != "emergencystop")
    cell.bring_up()
    return cell, guide


def test_the_robot_speaks_first_at_250_hz_and_fills_its_state(up):
    cell, guide = up
    first = guide.state()
    states = [guide.state() for _ in range(100)]
    assert states[-1].sequence == first.sequence + 100
    assert not first.unfit
    assert len(first.joints_deg) == 6
    assert first.feedback.x_mm == pytest.approx(8.0, abs=1e-6)
    lost_ms = cell.cell.egm.counters.lost_cycles * 1000 * CYCLE_S
    assert 400 <= states[-1].time_ms - first.time_ms <= 400 + lost_ms, "a cycle is 4 ms of the controller's clock"


def test_the_arm_follows_the_guide_and_holds_the_last_target(up):
    cell, guide = up
    last = guide.descend(10.0, 0.3)
    for _ in range(60):
        guide.send(last)
        state = guide.state()
    assert state.feedback.z_mm == pytest.approx(last.z_mm, abs=0.01)
    assert state.converged
    assert cell.cell.cabinet.egm == "guided"


def test_overtravel_after_a_stop_is_the_lag(up):
    cell, guide = up
    last = guide.descend(10.0, 0.4)
    for _ in range(80):
        guide.send(last)
        guide.state()
    stop = cell.call(lambda: cell.cell.stop_watch.stops[-1])
    assert stop.overtravel_mm == pytest.approx(0.2, abs=0.12)


def test_silence_of_the_guide_ends_the_run_and_holds(up):
    cell, guide = up
    pose = guide.descend(10.0, 0.2)
    silent_s = cell.cell.egm.controller_s
    guide.send(pose)  # the last target cannot arrive before the clock was read
    cell.wait(lambda: not cell.cell.cabinet.running, 30.0)
    module = Path(codec.__file__).with_name("TactileEgm.mod").read_text()
    limit_s = float(re.search(r"silenceLimit := ([0-9.]+);", module)[1])
    assert Settings().silence_s == limit_s, "guide and module have one time-out"
    assert cell.cell.egm.controller_s - silent_s >= limit_s
    z = cell.cell.cabinet.arm.pose.position_mm[2]
    time.sleep(0.2)
    assert cell.cell.cabinet.arm.pose.position_mm[2] == z
    assert any("timed out" in entry.title for entry in cell.cell.cabinet.log)


def test_a_target_that_is_not_finite_never_moves_the_arm(up):
    cell, guide = up
    state = guide.state()
    good = codec.encode_guidance(codec.Guidance(1, 0, state.feedback))
    bad = good.replace(struct.pack("<d", state.feedback.z_mm), struct.pack("<d", float("nan")))
    guide.sock.sendto(bad, guide.robot)
    cell.wait(lambda: not cell.cell.cabinet.running)
    assert cell.cell.cabinet.arm.at_rest


def test_garbage_is_ignored(up):
    cell, guide = up
    guide.state()
    refused = cell.cell.egm.counters.refused
    guide.sock.sendto(b"\xff" * 40, guide.robot)
    cell.wait(lambda: cell.cell.egm.counters.refused > refused)
    assert cell.cell.cabinet.running


@pytest.mark.parametrize(
    ("fault", "state"),
    [
        ({"emergency_stop": True}, "emergencystop"),
        ({"protective_stop": True}, "guardstop"),
        ({"motors_off": True}, "motoroff"),
    ],
)
def test_a_safety_stop_ends_motion_and_says_so_before_the_stream_ends(up, fault, state):
    cell, guide = up
    guide.descend(10.0, 0.15)
    cell.faults(robot=fault)
    cell.wait(lambda: cell.cell.cabinet.state == state)
    states = []
    guide.sock.settimeout(0.3)
    with pytest.raises(TimeoutError):
        forever(lambda: states.append(guide.state()))
    guide.sock.settimeout(20.0)
    assert states[-1].unfit
    assert not states[-1].motors_on
    assert cell.cell.cabinet.arm.at_rest


def test_a_silent_stream_and_a_frozen_stream_can_be_told_apart(up):
    cell, guide = up
    cell.faults(egm={"frozen": True})
    time.sleep(0.05)
    guide.drain()
    assert len({guide.state().sequence for _ in range(20)}) == 1
    cell.faults(egm={"silent": True, "frozen": False})
    time.sleep(0.05)
    guide.drain()
    guide.sock.settimeout(0.2)
    with pytest.raises(TimeoutError):
        guide.state()
    guide.sock.settimeout(20.0)


def test_dropped_garbled_and_delayed_datagrams_can_be_had(up):
    cell, guide = up
    cell.faults(egm={"drop_share": 0.5, "garbage_next": 30, "delay_ms": 20.0})
    bad, sequences = 0, []
    for _ in range(4000):  # what was sent before the fault may still be queued: count from the first garbled one
        try:
            state = guide.state()
        except codec.EgmError:
            bad += 1
            continue
        if bad:
            sequences.append(state.sequence)
        if len(sequences) == 40:
            break
    assert bad >= 1
    assert sequences[-1] - sequences[0] > len(sequences) + 5
