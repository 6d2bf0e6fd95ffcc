"""The arm without EGM: straight lines by RAPID, a guard that stops them, and a dead man behind both."""

import asyncio
import contextlib
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_client.codecs import rapid_text
from robot_client.codecs.egm import EgmError, Pose
from robot_client.codecs.rapid_text import RapidTextError, TextParser
from robot_client.drivers.abb_socket import SocketArm, SocketSettings
from robot_client.events import Arrived, Failure, Standstill
from robot_client.geometry import WorkPose
from robot_client.limits import LimitError, Limits
from robot_client.motion import Ramps
from tests.robot_client.rapid_peer import RapidPeer


def pose(x=5.0, z=45.0, yaw=0.0):
    return WorkPose(x_mm=x, y_mm=0.0, z_mm=z, yaw_deg=yaw)


@contextlib.asynccontextmanager
async def connected(**options):
    peer = RapidPeer(**options)
    motion_port, guard_port = await peer.start()
    settings = SocketSettings(host="127.0.0.1", motion_port=motion_port, guard_port=guard_port, poll_s=0.02)
    arm, events = SocketArm(settings, Limits(), Ramps()), asyncio.Queue()
    assert (await arm.start(events.put_nowait)).x_mm == pytest.approx(5.0)
    try:
        yield peer, arm, events
    finally:
        await arm.close()
        peer.close()


async def soon(events):
    return await asyncio.wait_for(events.get(), 30.0)


def test_a_move_is_released_carried_out_and_reported():
    async def story():
        async with connected() as (peer, arm, events):
            arm.move(pose(x=8.0, z=40.0, yaw=6.0), "travel")
            event = await soon(events)
            assert isinstance(event, Arrived)
            assert event.pose.distance_mm(pose(x=8.0, z=40.0)) < 0.2
            assert event.pose.yaw_deg == pytest.approx(6.0, abs=0.1)
            assert peer.moves[0][7] == 40.0

    asyncio.run(story())


def test_a_hold_goes_to_the_guard_at_once_and_standstill_follows():
    async def story():
        async with connected() as (peer, arm, events):
            arm.move(pose(z=20.0), "descend")
            await asyncio.sleep(0.6)
            arm.hold("slip", stop=False)
            event = await soon(events)
            assert isinstance(event, Standstill)
            assert peer.stop_from[2] - peer.position[2] == pytest.approx(10.0 * peer.stop_s, abs=0.1)
            arm.move(pose(z=45.0), "retract")
            assert isinstance(await soon(events), Arrived)

    asyncio.run(story())


def test_a_hold_right_after_a_move_keeps_it_from_ever_starting():
    async def story():
        async with connected() as (peer, arm, events):
            arm.move(pose(z=20.0), "descend")
            arm.hold("slip", stop=False)
            assert isinstance(await soon(events), Standstill)
            assert peer.moves == []

    asyncio.run(story())


def test_the_guard_stops_the_arm_when_the_client_falls_silent():
    async def story():
        async with connected(silence_s=0.3) as (peer, arm, events):
            arm.move(pose(z=20.0), "descend")
            await asyncio.sleep(0.3)
            arm._tasks[2].cancel()
            assert isinstance(await soon(events), Failure)  # the guard hung up
            await asyncio.wait_for(peer.at_rest.wait(), 30.0)
            assert peer.stopped_by_silence == 1
            assert peer.position[2] > 21.0, "stopped on the way"

    asyncio.run(story())


@pytest.mark.parametrize("fault", ["mute", "guard gone", "motion gone", "stop pressed"])
def test_trouble_is_a_failure_and_the_arm_takes_no_more_moves(fault):
    async def story():
        async with connected() as (peer, arm, events):
            arm.move(pose(z=20.0), "descend")
            await asyncio.sleep(0.2)
            if fault == "mute":
                peer.mute = True
            elif fault == "guard gone":
                peer.guard_writer.close()
            elif fault == "motion gone":
                peer.motion_writer.close()
            else:
                peer.stop_flag = True
            event = await soon(events)
            assert isinstance(event, Failure)
            count = len(peer.moves)
            with pytest.raises(LimitError):
                arm.move(pose(), "retract")
            await asyncio.wait_for(peer.at_rest.wait(), 30.0)
            assert len(peer.moves) == count
            assert peer.position[2] > 21.0, "stopped on the way"

    asyncio.run(story())


def test_no_move_leaves_the_box():
    async def story():
        async with connected() as (peer, arm, _):
            with pytest.raises(LimitError):
                arm.move(pose(z=1.0), "descend")
            assert peer.moves == []

    asyncio.run(story())


@given(st.integers(1, 99999), st.tuples(*[st.floats(-999, 999)] * 3), st.floats(0.1, 999))
def test_a_move_fits_a_rapid_string(number, position, speed):
    text = rapid_text.encode_move(number, Pose(*position, -0.5, 0.5, -0.5, 0.5), speed)
    assert len(text) <= 80
    assert text.endswith(b"#")


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -1.0, 0.0])
def test_bad_numbers_never_become_text(bad):
    with pytest.raises(RapidTextError):
        rapid_text.encode_move(1, Pose(0, 0, 0), bad)
    if not math.isfinite(bad):
        with pytest.raises(EgmError):
            rapid_text.encode_move(1, Pose(bad, 0, 0), 10.0)


@given(st.lists(st.binary(max_size=120), max_size=10))
def test_random_bytes_are_refused_without_harm(chunks):
    parser = TextParser()
    for chunk in chunks:
        for text in parser.feed(chunk):
            for decode in (rapid_text.decode_guard, rapid_text.decode_motion):
                with contextlib.suppress(ValueError):
                    decode(text)
    assert len(parser._rest) <= 80


@given(st.text(st.characters(codec="ascii"), max_size=80))
def test_a_guard_answer_is_read_or_refused(text):
    with contextlib.suppress(ValueError):
        rapid_text.decode_guard("P " + text)
