"""A gripper that stays connected knows what it holds; one that was left takes itself for idle."""

import asyncio
import contextlib

import pytest

from robot_client.grippers.dry_run.driver import DryGripper
from robot_client.grippers.wsg50.driver import Wsg50
from robot_client.insertion.events import Grasped, PartLost
from robot_client.ports import DriverError
from robot_client.session.commission.kept_gripper import KeptGripper
from tests.robot_client.grippers.wsg50.test_driver import bench


async def test_a_part_that_is_lost_while_a_press_closes_is_reported_in_the_next():
    async with bench() as cell:
        kept = KeptGripper(cell.driver)
        await kept.start(cell.events.put_nowait)
        kept.grasp()
        await cell.until(Grasped)
        cell.board.update({"gripper": {"part_lost": True}})
        await cell.until(PartLost)
        await kept.close()  # the press had ended before: it took no notice
        await kept.start(cell.events.put_nowait)
        await cell.until(PartLost)
        await kept.leave()
        cell.driver = Wsg50(cell.driver.settings)


@pytest.mark.parametrize("keeps", [True, False])
async def test_the_object_of_one_press_is_known_to_be_held_in_the_next(keeps):
    async with bench() as cell:
        kept = KeptGripper(cell.driver) if keeps else cell.driver
        await kept.start(cell.events.put_nowait)
        kept.grasp()
        await cell.until(Grasped)
        await (kept.close() if keeps else cell.anew())
        again = kept if keeps else cell.driver
        await again.start(cell.events.put_nowait)
        assert again.held == keeps
        if keeps:
            again.grasp()
            await cell.until(Grasped)


async def test_a_part_that_is_lost_between_two_presses_is_reported_in_the_next():
    async with bench() as cell:
        kept = KeptGripper(cell.driver)
        await kept.start(cell.events.put_nowait)
        kept.grasp()
        await cell.until(Grasped)
        await kept.close()
        while not cell.events.empty():
            cell.events.get_nowait()
        cell.board.update({"gripper": {"part_lost": True}})
        await asyncio.sleep(0.2)
        assert cell.events.empty(), "nobody listens"
        await kept.start(cell.events.put_nowait)
        await cell.until(PartLost)
        await kept.leave()
        cell.driver = Wsg50(cell.driver.settings)
        assert cell.emulator.counters.commands[-1].endswith("DISCONNECT"), "only `leave` lets go of the connection"


class HalfConnected(DryGripper):
    """Breaks where it is closed without a connection."""

    def __init__(self, ready=True):
        super().__init__()
        self.ready, self.link = ready, None

    async def start(self, post):
        self.link = ["open"]
        if not self.ready:
            raise DriverError("gripper: not homed")
        await super().start(post)

    async def close(self):
        self.link.clear()


@pytest.mark.parametrize("ready", [True, False])
async def test_only_a_gripper_that_was_reached_is_left(ready):
    await KeptGripper(HalfConnected()).leave()
    gripper = HalfConnected(ready)
    kept = KeptGripper(gripper)
    with contextlib.nullcontext() if ready else pytest.raises(DriverError):
        await kept.start(print)
    await kept.leave()
    assert gripper.link == []
