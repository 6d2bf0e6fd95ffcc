"""The arm without EGM: straight lines by RAPID, a guard that stops them, and a dead man behind both."""

import asyncio
import contextlib
import math
import time

import pytest

from robot_client.insertion.events import Arrived, Failure, Standstill
from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.limits import LimitError, Limits
from robot_client.insertion.motion import TURN_DEG_S, Ramp, Ramps
from robot_client.insertion.state import Phase
from robot_client.robots.abb_rapid.driver import SocketArm
from robot_client.robots.abb_rapid.settings import Settings
from simulation.cell.emulators.abb.cabinet import Cabinet, Delays
from simulation.cell.emulators.abb.motion import Follower, Pose, tool_down
from simulation.cell.emulators.abb.rapid import REACTION_S, RapidServers
from simulation.cell.emulators.faults import FaultBoard
from simulation.cell.emulators.net import bind_tcp
from tests.robot_client.live_cell import bench, undisturbed
from tests.waiting import until


def pose(x=5.0, z=45.0, yaw=0.0):
    return WorkPose(x_mm=x, y_mm=0.0, z_mm=z, yaw_deg=yaw)


@contextlib.asynccontextmanager
async def connected(**options):
    cabinet = Cabinet(Follower(Pose((5.0, 0.0, 45.0), tool_down(0.0))), FaultBoard(), Delays(program_start_s=0.0))
    peer = RapidServers(cabinet, **{"silence_s": 5.0, **options})
    await peer.start(bind_tcp(0, "motion"), bind_tcp(0, "guard"))
    clock = asyncio.create_task(run_clock(peer))
    cabinet.state = "motoron"
    cabinet.request_start()
    await until(lambda: cabinet.running)
    ports = {"motion_port": peer.motion_port, "guard_port": peer.guard_port}
    settings = Settings(host="127.0.0.1", poll_s=0.02, **ports)
    arm, events = SocketArm(settings, Limits(), Ramps()), asyncio.Queue()
    assert (await arm.start(events.put_nowait)).x_mm == pytest.approx(5.0)
    try:
        yield peer, arm, events
    finally:
        await arm.close()
        await peer.close()
        clock.cancel()


async def run_clock(peer):
    now_s = 0.0
    while True:
        now_s += 0.004
        peer.cabinet.advance(now_s)
        peer.cycle()
        await asyncio.sleep(0.004)


async def soon(events):
    return await asyncio.wait_for(events.get(), 30.0)


async def at_rest(peer):
    await until(lambda: not peer.moving and peer.cabinet.arm.at_rest)
    return peer.cabinet.arm.pose.position_mm[2]


async def test_a_move_is_released_carried_out_and_reported():
    async with connected() as (peer, arm, events):
        arm.move(pose(x=8.0, z=40.0, yaw=6.0), "travel")
        event = await soon(events)
        assert isinstance(event, Arrived)
        assert event.pose.distance_mm(pose(x=8.0, z=40.0)) < 0.2
        assert event.pose.yaw_deg == pytest.approx(6.0, abs=0.1)
        assert peer.moves[0].endswith(f" {Ramps().travel.speed_mm_s:.1f}")


@pytest.mark.parametrize("speed_mm_s", [5.0, 25.0, 80.0])
async def test_a_turn_on_the_spot_keeps_to_its_ramp(speed_mm_s):
    """In degrees as in millimetres, up to TURN_DEG_S; by the controller's clock."""
    async with connected() as (peer, arm, events):
        arm.ramps = Ramps(travel=Ramp(speed_mm_s=speed_mm_s, acceleration_mm_s2=300.0, jerk_mm_s3=5000.0))
        turned = peer.cabinet.board = Turned(peer, peer.cabinet.board)
        arm.move(pose(yaw=4.0), "travel")
        assert isinstance(await soon(events), Arrived)
        assert turned.fastest_deg_s <= min(speed_mm_s, TURN_DEG_S) * 1.001
        if speed_mm_s < 10.0:  # the emulated controller does not ramp up: a fast turn is over too soon
            assert turned.seconds >= arm.ramps.duration_s(pose(), pose(yaw=4.0), "travel")


class Turned:
    """Stands before the cabinet's faults, which are read every cycle, and measures the move under way."""

    def __init__(self, peer, board):
        self.peer, self.board, self.seconds, self.fastest_deg_s = peer, board, 0.0, 0.0

    @property
    def faults(self):
        if self.peer.moving:
            self.seconds += 0.004
            turn_deg_s = math.degrees(math.hypot(*self.peer.cabinet.arm.turn_rad_s))
            self.fastest_deg_s = max(self.fastest_deg_s, turn_deg_s)
        return self.board.faults


async def test_a_hold_goes_to_the_guard_at_once_and_standstill_follows():
    async with connected() as (peer, arm, events):
        arm.move(pose(z=20.0), "descend", 1e9)
        await until(lambda: peer.cabinet.arm.pose.position_mm[2] <= 42.0)
        flagged = []
        peer.cabinet.board = Flag(peer, flagged, peer.cabinet.board)
        arm.hold("slip", stop=False)
        assert isinstance(await soon(events), Standstill)
        assert 0.0 < flagged[0] - peer.cabinet.arm.pose.position_mm[2] < 10.0 * (REACTION_S + 0.004) + 0.05
        arm.move(pose(z=45.0), "retract")
        assert isinstance(await soon(events), Arrived)


class Flag:
    """Stands before the cabinet's faults, which are read every cycle, and notes where the arm was at the flag."""

    def __init__(self, peer, noted, board):
        self.peer, self.noted, self.board = peer, noted, board

    @property
    def faults(self):
        if self.peer.stop and not self.noted:
            self.noted.append(self.peer.cabinet.arm.pose.position_mm[2])
        return self.board.faults


async def test_a_hold_right_after_a_move_keeps_it_from_ever_starting():
    async with connected() as (peer, arm, events):
        arm.move(pose(z=20.0), "descend", 1e9)
        arm.hold("slip", stop=False)
        assert isinstance(await soon(events), Standstill)
        assert peer.moves == []


async def test_the_guard_stops_the_arm_when_the_client_falls_silent():
    async with connected(silence_s=0.3) as (peer, arm, events):
        arm.move(pose(z=20.0), "descend", 1e9)
        await asyncio.sleep(0.3)
        arm._tasks[2].cancel()
        assert isinstance(await soon(events), Failure)  # the guard hung up
        assert await at_rest(peer) > 21.0, "stopped on the way"
        assert peer.stopped_by_silence == 1


async def test_a_descent_goes_on_while_its_lease_is_renewed_and_stops_when_it_ends():
    async with connected() as (peer, arm, events):
        arm.move(pose(z=20.0), "descend", time.monotonic() + 0.2)
        arm.renew(time.monotonic() + 2.0)
        await asyncio.sleep(0.5)
        assert events.empty(), "the first lease counts no more"
        event = await soon(events)
        assert isinstance(event, Failure)
        assert event.code == "unwatched"
        assert await at_rest(peer) > 21.0, "stopped on the way"


@pytest.mark.parametrize("fault", ["mute", "guard gone", "motion gone", "stop pressed", "program stopped"])
async def test_trouble_is_a_failure_and_the_arm_takes_no_more_moves(fault):
    async with connected() as (peer, arm, events):
        arm.move(pose(z=20.0), "descend", 1e9)
        await asyncio.sleep(0.2)
        if fault == "mute":
            peer.mute = True
        elif fault == "program stopped":
            peer.cabinet.request_stop()
        elif fault == "stop pressed":
            peer.stop = True
        else:
            peer.hang_up(motion=fault == "motion gone", guard=fault == "guard gone")
        assert isinstance(await soon(events), Failure)
        count = len(peer.moves)
        with pytest.raises(LimitError):
            arm.move(pose(), "retract")
        assert await at_rest(peer) > 21.0, "stopped on the way"
        assert len(peer.moves) == count


async def test_an_arm_whose_program_is_stopped_in_a_move_has_failed_while_both_sockets_stay_open():
    """A guard in the background answers on: started again, the program would go on down where nobody expects it."""
    async with connected() as (peer, arm, events):
        arm.move(pose(z=20.0), "descend", 1e9)
        await until(lambda: peer.moving)
        await asyncio.sleep(0.2)
        peer.cabinet.request_stop()
        begun_s, event = time.monotonic(), await soon(events)
        assert (event.code, events.empty()) == ("stuck", True)
        assert time.monotonic() - begun_s > 0.9
        assert [writer.is_closing() for writer in (peer._motion, peer._guard)] == [False, False]
        await until(lambda: peer.stop)


async def test_no_move_leaves_the_box():
    async with connected() as (peer, arm, _):
        with pytest.raises(LimitError):
            arm.move(pose(z=1.0), "descend", 1e9)
        assert peer.moves == []


async def test_an_arm_that_was_closed_takes_no_more_moves():
    async with connected() as (peer, arm, _):
        await arm.close()
        with pytest.raises(LimitError, match="takes no motion: closed"):
            arm.move(pose(), "travel")
        assert peer.moves == []


async def test_what_the_modules_refuse_is_refused_by_their_emulation():
    async with connected() as (peer, _, _):
        for request, answer in (("M 4 0 0 40 0 1 0 0 90", "E 4 speed"), ("M 4 0 0", "E 0 format"), ("?", "E 0")):
            answers = []
            peer._answer = lambda _writer, text, answers=answers: answers.append(text)
            peer._on_move(request)
            assert answers[0].startswith(answer)
        assert peer.moves == []


def test_an_insertion_runs_over_the_sockets_from_program_start_to_program_stop():
    async def story():
        async with bench(device="abb_rapid") as cell:
            cell.cabinet.cycle = "once"
            state = await cell.insert()
            assert state.phase is Phase.INSERTED, state.reason
            assert cell.cabinet.cycle == "forever", "its servers begin anew after a lost connection"
            assert state.attempt == 2
            assert cell.runner.farewell.startswith("controller confirms")
            assert not cell.cabinet.running
            assert cell.egm.counters.received == 0
            assert cell.report.rows[0].overtravel_mm < 10.0 * (REACTION_S + 0.06)

    undisturbed(story)


def test_an_emergency_stop_which_closes_no_socket_is_named_by_the_controller():
    async def story():
        async with bench(device="abb_rapid") as cell:
            insertion = asyncio.create_task(cell.insert())
            await until(lambda: cell.rapid.moving)
            cell.board.update({"robot": {"emergency_stop": True}})
            state = await insertion
            assert state.reason.startswith("arm: stuck"), state.reason
            assert cell.runner.farewell == "controller confirms: program stopped, controller emergencystop"

    undisturbed(story)
