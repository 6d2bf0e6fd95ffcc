"""The robot that is answered, and the first answer: the started robot, at its arm's present pose."""

import asyncio
import contextlib
import math
import socket

import pytest

from robot_client.insertion.geometry import CellFrame, WorkPose
from robot_client.insertion.limits import LimitError, Limits
from robot_client.insertion.motion import Ramps
from robot_client.ports import DriverError
from robot_client.robots.abb_egm import codec
from robot_client.robots.abb_egm.driver import EgmArm
from robot_client.robots.abb_egm.settings import Settings
from robot_client.settings import load_settings
from tests.waiting import until


class Wire:
    """Stands in for the UDP socket; keeps sent data."""

    def __init__(self):
        self.sent = []

    def sendto(self, datagram, _address):
        self.sent.append(codec.decode_guidance(datagram).pose)


def answers_to(tilt_deg, then=(), **state):
    """Answers to ten datagrams of a resting arm with a tilted tool, and the reported failure.

    ``then``: what the last five say instead.
    """
    half = math.radians(180.0 - tilt_deg) / 2.0
    measured = codec.Pose(5.0, 0.0, 60.0, math.cos(half), math.sin(half), 0.0, 0.0)
    arm, wire = EgmArm(Settings(), Limits(), Ramps()), Wire()
    arm._socket, arm._robot = wire, ("127.0.0.1", 6510)
    for number in range(10):
        says = dict(then) if number >= 5 else {}
        datagram = codec.encode_robot(codec.RobotState(number, 4 * number, measured, **state | says))
        arm._on_datagram(datagram, 0.004 * number)
    return wire.sent, arm._watch.not_ready


def test_an_arm_that_hangs_upright_is_held_where_it_stands():
    sent, _ = answers_to(0.0)
    assert len(sent) == 10
    for pose in sent:
        here, tilt_deg = CellFrame().from_controller(pose)
        assert (here.distance_mm(WorkPose(x_mm=5.0, y_mm=0.0, z_mm=60.0, yaw_deg=0.0)), tilt_deg) == (0.0, 0.0)


def test_a_tilted_arm_is_never_answered_since_every_target_would_turn_it_upright():
    sent, reason = answers_to(25.0)
    assert sent == []
    assert "tilted by 25.00 deg, allowed 2" in reason
    assert answers_to(25.0, then={"mc_state": "stopped"}) == ([], reason), "nor once its guidance has timed out"


@pytest.mark.parametrize("mc_state", ["undefined", "stopped"])
def test_a_controller_whose_guidance_does_not_run_yet_is_answered_with_where_it_stands_and_does_not_move(mc_state):
    """It may run only once a guide answers, as ABB's own examples do to every datagram."""
    sent, reason = answers_to(25.0, mc_state=mc_state)
    assert len(sent) == 10
    here, tilt_deg = CellFrame().from_controller(sent[0])
    assert (set(sent), tilt_deg) == ({sent[0]}, pytest.approx(25.0))
    assert here.distance_mm(WorkPose(x_mm=5.0, y_mm=0.0, z_mm=60.0, yaw_deg=0.0)) == 0.0
    assert reason == f"motion control reports EGM {mc_state}"
    assert answers_to(0.0, mc_state=mc_state, motors_on=False)[0] == answers_to(0.0, mc_state="error")[0] == []


@pytest.mark.parametrize("turns", range(5))
async def test_an_interrupt_that_comes_together_with_the_first_datagram_is_not_lost(turns):
    """Else `try arm` would move it afterwards."""
    arm = EgmArm(Settings(port=0, bind="127.0.0.1"), Limits(), Ramps())
    starting = asyncio.create_task(arm.start([].append))
    await asyncio.sleep(0)
    state = codec.RobotState(0, 0, codec.Pose(5.0, 0.0, 60.0, 0.0, 1.0, 0.0, 0.0))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as robot:
        robot.sendto(codec.encode_robot(state), arm._socket.getsockname())
        await until(arm._ready.is_set, 0)
    for _ in range(turns):
        await asyncio.sleep(0)
    done = starting.done()
    starting.cancel()
    await asyncio.wait([starting])
    await arm.close()
    assert starting.cancelled() == (not done)


@pytest.mark.parametrize(("tilt_deg", "held"), [(0.0, False), (1.9, False), (2.1, True), (25.0, True)])
async def test_a_guided_arm_takes_no_motion_once_its_tool_tilts_beyond_the_limit(tilt_deg, held):
    arm, posted = EgmArm(Settings(), Limits(), Ramps()), []
    arm._socket, arm._robot, arm._post = Wire(), ("127.0.0.1", 6510), posted.append
    for number, tilt in enumerate((0.0, tilt_deg)):
        half = math.radians(180.0 - tilt) / 2.0
        measured = codec.Pose(5.0, 0.0, 60.0, math.cos(half), math.sin(half), 0.0, 0.0)
        arm._on_datagram(codec.encode_robot(codec.RobotState(number, 4 * number, measured)), 0.004 * number)
        arm._timer = arm._timer or asyncio.get_running_loop().call_later(60.0, print)
    arm._timer.cancel()
    refused = pytest.raises(LimitError, match=rf"tilted by {tilt_deg:.2f} deg, allowed 2")
    with refused if held else contextlib.nullcontext():
        arm.move(WorkPose(x_mm=5.0, y_mm=0.0, z_mm=65.0, yaw_deg=0.0), "travel")


@pytest.mark.parametrize("url", ["http://127.0.0.1:8", "http://localhost:8"])
async def test_only_the_robot_whose_program_is_started_is_guided(url):
    settings = load_settings(None, {"robot": {"rws": {"url": url}}})
    arm = settings.make_arm()
    assert not arm._is_robot(("192.0.2.7", 6510)), "another robot that sends to the same port"
    assert arm._is_robot(("127.0.0.1", 6510))
    await arm.rws._client.aclose()


class Line:
    """A socket on which these datagrams wait; keeps the answers whole."""

    def __init__(self, *waiting):
        self.waiting, self.answers = list(waiting), []

    def recvfrom(self, most_bytes):
        if not self.waiting:
            raise BlockingIOError
        datagram, address = self.waiting.pop(0)
        return datagram[:most_bytes], address

    def sendto(self, datagram, address):
        self.answers.append((codec.decode_guidance(datagram), address))


ROBOT, OTHER = ("192.0.2.7", 6511), ("192.0.2.8", 6511)
UPRIGHT = codec.Pose(5.0, 0.0, 60.0, 0.0, 1.0, 0.0, 0.0)


def datagram(number, padding=b""):
    return codec.encode_robot(codec.RobotState(number, 4 * number, UPRIGHT)) + padding


def listening(*waiting, **settings):
    arm = EgmArm(Settings(**settings), Limits(), Ramps())
    arm._socket, arm._post = Line(*waiting), lambda _event: None
    return arm


def test_of_the_datagrams_that_wait_the_newest_is_answered_with_numbers_that_go_up(monkeypatch):
    monkeypatch.setattr("robot_client.robots.abb_egm.driver.time.monotonic_ns", lambda: 1_234_567_890_123_456)
    arm = listening(*((datagram(number), ROBOT) for number in range(3)))
    arm._on_readable()
    arm._socket.waiting = [(datagram(number), ROBOT) for number in (3, 4)]
    arm._on_readable()
    arm._on_readable()
    assert [answer.sequence for answer, _ in arm._socket.answers] == [1, 2]
    assert {address for _, address in arm._socket.answers} == {ROBOT}
    assert {answer.time_ms for answer, _ in arm._socket.answers} == {1_234_567_890 % 2**32}
    assert arm.statistics()["datagrams"] == 5
    assert arm.statistics()["repeated"] == 0, "the others were passed over, not refused"


@pytest.mark.parametrize("robot_host", [None, "192.0.2.7"])
def test_only_the_first_robot_or_the_configured_one_is_answered(robot_host):
    mixed = [(datagram(1), ROBOT), (datagram(2), OTHER), (datagram(3), (ROBOT[0], 9)), (datagram(4), ROBOT)]
    arm = listening(*mixed, robot_host=robot_host)
    arm._on_readable()
    counts = arm.statistics()
    assert (counts["datagrams"], counts["foreign_datagrams"]) == (2, 2)
    assert [address for _, address in arm._socket.answers] == [ROBOT]


def test_the_last_datagrams_of_a_run_that_ended_do_not_hide_the_next_one():
    """It counts from 0 again, on a clock and from a port of its own."""
    arm, port = listening(), (ROBOT[0], 7000)
    for number in range(5000, 5100):
        ended = codec.RobotState(number, 4 * number, UPRIGHT, rapid_running=False)
        arm._socket.waiting = [(codec.encode_robot(ended), ROBOT)]
        arm._on_readable()
    assert arm._socket.answers == []
    for number in range(3):
        arm._socket.waiting = [(datagram(number), port)]
        arm._on_readable()
    assert [address for _, address in arm._socket.answers] == [port] * 3


def test_a_datagram_that_is_too_long_is_not_taken_for_its_own_beginning():
    """A field that nobody knows fills it up to a byte more than is allowed; cut anywhere, it would be a good one."""
    base = datagram(1)
    longest = codec.MAX_DATAGRAM_BYTES - len(base)
    for extra, bad_n in ((0, 0), (2, 1)):
        arm = listening((datagram(1, b"\x78\x00" * ((longest + extra) // 2)), ROBOT))
        arm._on_readable()
        assert arm.statistics()["bad_datagrams"] == bad_n


def test_a_sender_without_end_does_not_keep_the_others_waiting():
    arm = listening(*((datagram(number), ROBOT) for number in range(1000)))
    arm._on_readable()
    assert 0 < arm.statistics()["datagrams"] < 100


async def test_an_arm_that_was_never_started_knows_nothing_moves_nothing_and_closes():
    arm = EgmArm(Settings(), Limits(), Ramps())
    assert (arm.position(), arm.target(), arm.signals()) == (None, None, None)
    assert set(arm.statistics().values()) == {0}
    arm.renew(1.0)
    arm.hold("too early", stop=False)
    with pytest.raises(LimitError, match="not started"):
        arm.move(WorkPose(x_mm=5.0, y_mm=0.0, z_mm=65.0, yaw_deg=0.0), "travel")
    assert list(arm.checks()) == ["guidance"]
    assert await arm.close() == "no program was started"


async def test_the_port_to_listen_on_is_free_or_named():
    arm = EgmArm(Settings(bind="127.0.0.1", port=0), Limits(), Ramps())
    (finding,) = await arm.checks()["guidance"]()
    assert (finding.good, "UDP 127.0.0.1:0 is free" in finding.text) == (True, True)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        arm.settings = Settings(bind="127.0.0.1", port=other.getsockname()[1])
        with pytest.raises(DriverError, match="cannot listen on UDP 127"):
            await arm.checks()["guidance"]()


def test_an_order_to_stop_latches_the_arm_with_its_first_reason_and_a_hold_does_not():
    arm = listening((datagram(1), ROBOT))
    arm._on_readable()
    up = WorkPose(x_mm=5.0, y_mm=0.0, z_mm=65.0, yaw_deg=0.0)
    arm.hold("slip", stop=False)
    arm.move(up, "travel")
    for reason in ("operator: stop", "again"):
        arm.hold(reason, stop=True)
        with pytest.raises(LimitError, match="takes no motion: operator: stop"):
            arm.move(up, "travel")
    assert [answer.sequence for answer, _ in arm._socket.answers] == [1, 2, 3, 4], "each hold is sent at once"


@pytest.mark.parametrize(("came", "why"), [([], "no datagram came: check"), ([b"x"], "does not parse")])
async def test_why_an_arm_does_not_get_ready_is_told(came, why):
    settings = Settings(bind="127.0.0.1", port=0, ready_timeout_s=0.05)
    arm = EgmArm(settings, Limits(), Ramps())
    arm._foreign, arm._watch.datagrams = 2 * len(came), len(came)
    for one in came:
        arm._on_datagram(one, 0.0)
    with pytest.raises(DriverError, match=rf"EGM not ready on UDP port \d+ in 0.05 s: .*{why}"):
        await arm.start(lambda _event: None)
    assert await arm.close() == "no program was started"


async def test_a_robot_named_in_the_settings_is_the_one_that_is_guided_whatever_the_address_of_its_services(
    monkeypatch,
):
    def unknown(_name):
        raise OSError

    for url, named, guided in (
        ("http://127.0.0.1:8", "192.0.2.7", "192.0.2.7"),
        ("http://127.0.0.1:8", None, "127.0.0.1"),
        ("http://no-such-robot", None, "no-such-robot"),  # and not whoever sends first
    ):
        if "no-such" in url:
            monkeypatch.setattr("robot_client.robots.abb_egm.driver.socket.gethostbyname", unknown)
        arm = load_settings(None, {"robot": {"robot_host": named, "rws": {"url": url}}}).make_arm()
        assert arm.settings.robot_host == guided
        await arm.rws._client.aclose()


def test_the_worst_times_of_an_answer_and_of_a_hold_are_told_in_microseconds(monkeypatch):
    """On a clock that goes on by 150 us, 40 us and 90 us between what is measured."""
    ticks_ns = iter([10**9, 10**9 + 150_000, 2 * 10**9, 2 * 10**9 + 40_000, 3 * 10**9, 3 * 10**9 + 90_000])
    monkeypatch.setattr("robot_client.robots.abb_egm.driver.time.perf_counter_ns", lambda: next(ticks_ns))
    arm = listening((datagram(1), ROBOT))
    arm._on_readable()
    arm._socket.waiting = [(datagram(2), ROBOT)]
    arm._on_readable()
    arm.hold("slip", stop=False)
    assert (arm.statistics()["worst_reply_us"], arm.statistics()["worst_hold_us"]) == (150, 90)
