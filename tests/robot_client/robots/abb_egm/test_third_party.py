"""Clients that strangers wrote run unmodified against the emulated controller, so our client is not its only witness.

Subprocesses: the EGM messages of the two libraries cannot be loaded into one process.
"""

import asyncio
import os
import sys
from pathlib import Path

import pytest

from robot_client.robots.abb_rws.client import RwsClient
from tests.robot_client.live_cell import bench

HERE = Path(__file__).parent


async def _start(script, *arguments):
    environment = {**os.environ, "PYTHONWARNINGS": "ignore"}
    pipe = asyncio.subprocess.PIPE
    return await asyncio.create_subprocess_exec(
        sys.executable, str(HERE / script), *map(str, arguments), stdout=pipe, stderr=pipe, env=environment
    )


async def _finish(process):
    out, err = await asyncio.wait_for(process.communicate(), 60.0)
    assert process.returncode == 0, err.decode()
    return out.decode()


@pytest.mark.slow
def test_abb_robot_client_starts_guides_and_stops_the_emulated_robot():
    pytest.importorskip("abb_robot_client")

    async def story():
        async with bench() as cell:
            url, port = cell.settings.robot.rws.url, cell.settings.robot.port
            before = cell.cabinet.arm.pose.position_mm[2]
            out = await _finish(await _start("peer_abb_robot_client.py", url, port))
            assert cell.cabinet.arm.pose.position_mm[2] - before == pytest.approx(2.0, abs=0.05)
            assert not cell.cabinet.running
            assert cell.egm.counters.refused == 0
            return out

    assert "followed" in asyncio.run(story())


def test_abbrobotegm_guides_what_our_rws_client_started():
    pytest.importorskip("ABBRobotEGM")

    async def story():
        async with bench() as cell:
            before = cell.cabinet.arm.pose.position_mm[2]
            process = await _start("peer_abb_robot_egm.py", cell.settings.robot.port)
            await asyncio.wait_for(process.stdout.readline(), 60.0)
            client = RwsClient(cell.settings.robot.rws)
            await client.start_program()
            out = await _finish(process)
            assert "confirms" in await client.stop_program()
            await client.close()
            assert cell.cabinet.arm.pose.position_mm[2] - before == pytest.approx(2.0, abs=0.05)
            assert cell.egm.counters.refused == 0
            return out

    assert "followed" in asyncio.run(story())
