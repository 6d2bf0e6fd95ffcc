"""A rehearsal takes the same orders as the arm, walks the same way and ends it for the same reasons."""

import asyncio
import contextlib
import itertools

import pytest

from robot_client.insertion.events import Arrived, Failure, Standstill
from robot_client.insertion.geometry import CellFrame, WorkPose
from robot_client.insertion.lease import PAUSE_S
from robot_client.insertion.limits import LimitError, Limits
from robot_client.insertion.motion import CYCLE_S, SETTLE_S, Ramps
from robot_client.robots.dry_run import driver
from robot_client.robots.dry_run.driver import Settings
from tests.robot_client.clock import stopped_clock
from tests.waiting import until


@pytest.fixture
def clock(monkeypatch):
    return stopped_clock(monkeypatch, driver)


@contextlib.asynccontextmanager
async def rehearsed():
    """A started arm, its targets, and the coroutine of its next event."""
    arm = driver.make(Settings(), Limits(), Ramps(), CellFrame())
    way, events = [], asyncio.Queue()
    arm.on_target = way.append
    begun = await arm.start(events.put_nowait)
    assert begun == arm.target() == arm.position() == arm.settings.start
    try:
        yield arm, way, lambda: asyncio.wait_for(events.get(), 20.0)
    finally:
        assert await arm.close() == "dry run: no controller"
        assert arm._task.cancelled()


async def test_a_move_is_walked_target_by_target_and_its_arrival_reported(clock):
    clock.now_s = 7.0
    async with rehearsed() as (arm, way, event):
        goal = arm.target().at_height(70.0)
        arm.move(goal, "travel")
        arrived = await event()
        assert (type(arrived), arrived.pose, arrived.at_s) == (Arrived, goal, 7.0)
        assert len(way) == arm.statistics()["dry_cycles"]
        lasts_s = Ramps().duration_s(arm.settings.start, goal, "travel") + SETTLE_S
        assert len(way) * CYCLE_S == pytest.approx(lasts_s, abs=3 * CYCLE_S), "nothing is counted before the move"
        assert all(high.z_mm >= low.z_mm for high, low in itertools.pairwise(way))


async def test_a_hold_freezes_the_target_and_its_standstill_says_for_how_long(clock):
    async with rehearsed() as (arm, way, event):
        arm.move(arm.target().at_height(60.0), "descend", 1e9)
        await until(lambda: len(way) >= 200)
        arm.hold("slip", stop=False)
        held = arm.target()
        stands = await event()
        assert (type(stands), stands.pose, stands.still_s) == (Standstill, held, SETTLE_S)
        assert arm.target() == held


async def test_a_lease_that_ends_is_a_failure_as_with_the_arm_and_one_that_is_renewed_is_none(clock):
    async with rehearsed() as (arm, way, event):
        arm.move(arm.target().at_height(74.0), "descend", 1.0)
        arm.renew(9.0)
        clock.now_s = 2.0
        assert isinstance(await event(), Arrived)
        arm.move(arm.target().at_height(60.0), "descend", 3.0)
        clock.now_s = 3.0
        await until(lambda: len(way) >= 2000)
        clock.now_s = 3.0 + PAUSE_S + 0.01
        failure = await event()
        assert (type(failure), failure.source, failure.code) == (Failure, "arm", "unwatched")


async def test_a_target_beyond_the_limits_is_a_failure_and_one_outside_the_box_is_not_begun(clock):
    async with rehearsed() as (arm, _way, event):
        with pytest.raises(LimitError, match="z_mm"):
            arm.move(arm.target().at_height(1.0), "travel")
        arm.move(arm.target().at_height(60.0), "travel")
        arm._guide._guard.limits = Limits(max_speed_mm_s=1.0)
        failure = await event()
        assert (failure.code, "speed" in failure.detail) == ("limits", True)


def test_a_rehearsal_begins_where_it_ships():
    assert Settings().start == WorkPose(x_mm=0.0, y_mm=0.0, z_mm=75.0, yaw_deg=0.0)
    assert Settings.pauses
