"""A rehearsal's gripper holds something whenever it is asked to, as wide as its settings say, and lets it go."""

import asyncio

from robot_client.grippers.dry_run.driver import DryGripper, Settings
from robot_client.insertion.events import Grasped


async def test_a_rehearsed_gripper_grasps_at_once_and_releases_where_it_is_told_to():
    gripper, events = DryGripper(Settings(width_mm=42.0)), asyncio.Queue()
    await gripper.connect()
    await gripper.start(events.put_nowait)
    assert events.empty(), "nobody has asked for anything"
    gripper.grasp()
    event = await asyncio.wait_for(events.get(), 20.0)
    assert (type(event), event.width_mm) == (Grasped, 42.0)
    assert await gripper.width_mm() == 42.0
    assert await gripper.release(60.0) == 60.0
    assert await gripper.finds_nothing()
    await gripper.close()
