"""Clients that strangers wrote run unmodified against the emulated controller, so our client is not its only witness.

Subprocesses: the EGM messages of the two libraries cannot be loaded into one process.
"""

import asyncio
import os
import subprocess
import sys
from pathlib import Path

import pytest

from robot_client.insertion.geometry import Pose
from robot_client.robots.abb_egm import tactile_insertion_egm_pb2 as pb
from robot_client.robots.abb_egm.codec import decode_robot
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
async def test_abb_robot_client_starts_guides_and_stops_the_emulated_robot():
    pytest.importorskip("abb_robot_client")
    async with bench() as cell:
        url, port = cell.settings.robot.rws.url, cell.settings.robot.port
        before = cell.cabinet.arm.pose.position_mm[2]
        assert "followed" in await _finish(await _start("peer_abb_robot_client.py", url, port))
        assert cell.cabinet.arm.pose.position_mm[2] - before == pytest.approx(2.0, abs=0.05)
        assert not cell.cabinet.running
        assert cell.egm.counters.refused == 0


async def test_abbrobotegm_guides_what_our_rws_client_started():
    pytest.importorskip("ABBRobotEGM")
    async with bench() as cell:
        before = cell.cabinet.arm.pose.position_mm[2]
        process = await _start("peer_abb_robot_egm.py", cell.settings.robot.port)
        await asyncio.wait_for(process.stdout.readline(), 60.0)
        client = RwsClient(cell.settings.robot.rws)
        await client.start_program()
        assert "followed" in await _finish(process)
        assert "confirms" in await client.stop_program()
        await client.close()
        assert cell.cabinet.arm.pose.position_mm[2] - before == pytest.approx(2.0, abs=0.05)
        assert cell.egm.counters.refused == 0


ROBOTWARE_7 = """
import sys
from ABBRobotEGM._egm_protobuf import egm_pb2 as pb
said = pb.EgmRobot()
said.header.seqno, said.header.tm, said.header.mtype = 7, 28, pb.EgmHeader.MSGTYPE_DATA
for block in (said.feedBack, said.planned):
    block.cartesian.pos.x, block.cartesian.pos.y, block.cartesian.pos.z = 1.0, 2.0, 3.0
    block.cartesian.orient.u0, block.cartesian.orient.u1 = 1.0, 0.0
    block.cartesian.orient.u2, block.cartesian.orient.u3 = 0.0, 0.0
    block.timeStamp.sec, block.timeStamp.nsec = 12, 345
said.motorState.state = pb.EgmMotorState.MOTORS_ON
said.rapidExecState.state = pb.EgmRapidCtrlExecState.RAPID_RUNNING
said.mciState.state = pb.EgmMCIState.MCI_RUNNING
said.CollisionInfo.collsionTriggered = True
said.CollisionInfo.collDetQuota.append(1.5)
said.RAPIDfromRobot.digVal = True
said.RAPIDfromRobot.dnum.append(0.5)
said.torqueRef.joints.extend([0.1] * 6)
sys.stdout.buffer.write(said.SerializeToString())
"""


def test_what_abbrobotegm_knows_of_robotware_7_is_read_and_a_collision_ends_guidance():
    pytest.importorskip("ABBRobotEGM")
    done = subprocess.run([sys.executable, "-c", ROBOTWARE_7], check=True, capture_output=True)
    state = decode_robot(done.stdout)
    assert (state.sequence, state.feedback, state.collided) == (7, Pose(1.0, 2.0, 3.0), True)
    assert state.unfit
    read = pb.EgmRobot.FromString(done.stdout)
    assert (read.feedBack.timeStamp.nsec, list(read.RAPIDfromRobot.dnum)) == (345, [0.5])
    assert read.SerializeToString() == done.stdout
