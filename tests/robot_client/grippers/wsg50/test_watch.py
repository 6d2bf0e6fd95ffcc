"""The link to the gripper: the grasping state itself keeps the watch over a grasp alive, and every end is announced."""

import asyncio

import pytest

from robot_client.grippers.wsg50 import codec, driver
from robot_client.grippers.wsg50.codes import Command, GraspingState, Status
from robot_client.grippers.wsg50.driver import Wsg50
from robot_client.grippers.wsg50.settings import Settings
from robot_client.insertion.events import Failure
from tests.robot_client.clock import stopped_clock
from tests.robot_client.grippers.wsg50.test_driver import bench
from tests.waiting import until


@pytest.fixture
def clock(monkeypatch):
    return stopped_clock(monkeypatch, driver)


def receives(gripper, *frame):
    gripper._link.take(codec.encode_reply(*frame))


@pytest.mark.parametrize(
    "frame", [(Command.GRASPING_STATE, Status.NOT_AVAILABLE), (Command.WIDTH, Status.SUCCESS, 50.0)]
)
def test_frames_without_a_grasping_state_are_silence(clock, frame):
    gripper = Wsg50(Settings())
    receives(gripper, Command.GRASPING_STATE, Status.SUCCESS, int(GraspingState.HOLDING))
    for _ in range(10):
        clock.now_s += 0.1
        receives(gripper, *frame)
        silent_s = gripper._silence.over(clock.now_s)
    assert silent_s == pytest.approx(1.0)


def test_the_state_is_looked_at_four_times_within_the_silence_that_is_allowed(clock, monkeypatch):
    gripper, waits_s = Wsg50(Settings(silence_s=0.8)), []

    async def sleep(wait_s):
        waits_s.append(wait_s)
        if len(waits_s) > 3:
            raise asyncio.CancelledError

    monkeypatch.setattr(driver.asyncio, "sleep", sleep)
    with pytest.raises(asyncio.CancelledError):
        asyncio.run(gripper._watch())
    assert waits_s == [pytest.approx(0.2)] * 4


async def test_a_defect_of_ours_in_handling_a_reply_is_a_failure_at_once_and_not_a_silence():
    async with bench(silence_s=20.0) as cell:
        await cell.started()
        cell.driver._link.on_reply = lambda _reply: 1 / 0
        failure = await cell.until(Failure)
    assert (failure.code, failure.detail) == ("link", "gripper: ZeroDivisionError: division by zero")


async def test_a_client_that_is_stopped_while_it_connects_says_that_it_leaves():
    async with bench() as cell:
        connecting = asyncio.create_task(cell.driver.connect())
        await until(lambda: cell.emulator.connection is not None, 0)
        connecting.cancel()
        with pytest.raises(asyncio.CancelledError):
            await connecting
        await cell.anew()
        await until(lambda: cell.emulator.connection is None, 0)
    assert cell.emulator.counters.fast_stops_by_disconnect == 0


@pytest.mark.parametrize("turns", range(8))
async def test_an_interrupt_that_comes_together_with_a_reply_is_not_lost(turns):
    """Else the fingers would close after it."""
    async with bench(present=False, holding=False) as cell:
        await cell.driver.connect()
        closing = asyncio.create_task(cell.driver.finds_nothing())
        await until(lambda: "SET_FORCE_LIMIT" in cell.asked, 0)
        for _ in range(turns):
            await asyncio.sleep(0)
        closing.cancel()
        await asyncio.wait([closing])
        assert closing.cancelled()
