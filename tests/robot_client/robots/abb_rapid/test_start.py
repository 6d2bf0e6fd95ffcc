"""Who does not get as far as the first position is told what is missing."""

import asyncio
import contextlib
import re
import socket
import time

import pytest

from robot_client.insertion.limits import Limits
from robot_client.insertion.motion import Ramps
from robot_client.ports import DriverError
from robot_client.robots.abb_rapid.driver import SocketArm
from robot_client.robots.abb_rapid.settings import Settings
from simulation.cell.emulators.net import free_port
from tests.robot_client.live_cell import bench


@contextlib.asynccontextmanager
async def listening():
    """A port that takes connections and says nothing."""
    heard = []

    async def serve(_reader, writer):
        heard.append(writer)

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    try:
        yield server.sockets[0].getsockname()[1]
    finally:
        for writer in heard:
            writer.close()
        server.close()


async def refusal(**settings):
    """Why an arm with these settings does not start."""
    arm = SocketArm(Settings(host="127.0.0.1", **settings), Limits(), Ramps())
    with pytest.raises(DriverError) as refused:
        await asyncio.wait_for(arm.start(lambda _event: None), 20.0)
    await arm.close()
    return str(refused.value)


@pytest.mark.parametrize("missing", ["motion server", "guard"])
async def test_a_program_that_does_not_listen_is_named(missing):
    """With one of its two ports, or with none; a port may open late, and is tried for as long as is set."""
    closed, begun_s = free_port(socket.SOCK_STREAM), time.monotonic()
    async with listening() as port:
        motion_port = closed if missing == "motion server" else port
        why = await refusal(connect_timeout_s=0.15, motion_port=motion_port, guard_port=closed)
    assert f"cannot connect to the {missing} at 127.0.0.1:{closed}" in why
    assert time.monotonic() - begun_s > 0.15


async def test_a_guard_that_says_nothing_is_no_start():
    async with listening() as port:
        why = await refusal(connect_timeout_s=0.1, motion_port=port, guard_port=port)
    assert "does not report where the arm is" in why


async def test_modules_of_another_release_are_refused_by_name():
    """Whose guard also says whether the arm moves."""

    async def guard(reader, writer):
        while data := await reader.read(80):
            number = data.decode().split("#")[0].split()[1]
            writer.write(f"P {number} 0 0 40 0 1 0 0 0 1#".encode())
        writer.close()

    server = await asyncio.start_server(guard, "127.0.0.1", 0)
    async with listening() as motion:
        why = await refusal(motion_port=motion, guard_port=server.sockets[0].getsockname()[1], silence_s=20.0)
    server.close()
    assert why.startswith("robot: protocol: the guard answered 'P ")
    assert why.endswith("expected P with nine fields: load TactileGuard.mod and TactileMotion.mod of this release")


@pytest.mark.parametrize("answers", [True, False])
async def test_a_motion_server_that_hangs_up_before_the_first_move_is_named(answers):
    async def hang_up(_reader, writer):
        writer.close()

    async def guard(reader, writer):
        while (data := await reader.read(80)) and answers:
            number = data.decode().split("#")[0].split()[1]
            writer.write(f"P {number} 0 0 40 0 1 0 0 1#".encode())
        writer.close()

    servers = [await asyncio.start_server(serve, "127.0.0.1", 0) for serve in (hang_up, guard)]
    motion, guarded = (server.sockets[0].getsockname()[1] for server in servers)
    why = await refusal(motion_port=motion, guard_port=guarded, silence_s=20.0)
    assert re.search(r"robot: link: the (motion server|guard) closed the connection", why)
    for server in servers:
        server.close()


async def test_a_controller_that_would_move_more_slowly_than_ordered_is_not_started():
    async with asyncio.timeout(60.0), bench(device="abb_rapid") as cell:
        cell.cabinet.speed_ratio = 50
        arm = cell.settings.make_arm()
        findings = await arm.checks()["robot"]()
        with pytest.raises(DriverError, match=r"^robot: speed ratio is 50 % .expected 100.*; set it on the pendant"):
            await arm.start(lambda _event: None)
        await arm.close()
        assert not cell.cabinet.running
    assert [finding.text for finding in findings if not finding.good] == [
        "speed ratio 50 % (expected 100: the service is told how fast the arm moves)"
    ]
