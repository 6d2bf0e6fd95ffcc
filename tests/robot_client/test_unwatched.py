"""The client over real sockets without judged frames: the arm's overtravel stays below the bound."""

import asyncio
import time

import pytest

from robot_client.insertion.state import Phase
from tests.robot_client.live_cell import bench
from tests.waiting import until

BOUND_MM = 1.5
SLOW = {
    "ramps": {"descend": {"speed_mm_s": 5.0, "acceleration_mm_s2": 100.0, "jerk_mm_s3": 2000.0}}
}  # this process also plays robot and service, and may pause


def blind(cell):
    """Cameras stalled, frozen or black: the service judges nothing more, but answers every heartbeat."""
    cell.service.sees = False


def mute(cell):
    """A half-open link, or a stopped service: nothing arrives any more."""
    cell.service.mute = True


async def unwatched(break_it):
    """Break off the watching in mid-descent; the final state, and the way in mm after the last judged frame."""
    async with bench(lag_ms=20.0) as cell:
        captures_s = []
        say = cell.service.say

        async def noted(reply):
            if getattr(reply, "type", "") == "watching" and cell.service.sees and not cell.service.mute:
                captures_s.append(reply.frame_captured_ns / 1e9)
            await say(reply)

        cell.service.say = noted
        insertion = asyncio.create_task(cell.insert(x_mm=1.0, theta_deg=0.0))
        await until(lambda: insertion.done() or len(captures_s) >= 8)
        break_it(cell)
        state = await insertion
        await asyncio.sleep(0.3)
        heights = [(now, pose.position_mm[2]) for now, _, pose in cell.trace]
        at_last = next(z for now, z in heights if now >= captures_s[-1])
        return (
            state,
            at_last - heights[-1][1],
            [target for now, target, _ in cell.trace if now > time.monotonic() - 0.2],
        )


@pytest.mark.parametrize("break_it", [blind, mute])
def test_the_arm_stops_within_the_bound_when_nobody_looks(break_it):
    state, way_mm, late_targets = asyncio.run(asyncio.wait_for(unwatched(break_it), 60.0))
    assert state.phase is Phase.FAILED
    assert "unwatched" in state.reason
    assert way_mm <= BOUND_MM
    assert len({target.position_mm for target in late_targets}) == 1, "no motion after a hold"


@pytest.mark.slow
def test_a_wall_clock_that_is_stepped_changes_nothing(monkeypatch):
    """All ages are counted on monotonic clocks: an hour back or forth in mid-descent is not even noticed."""
    real_s = time.time

    async def story():
        async with bench(overrides=SLOW) as cell:
            insertion = asyncio.create_task(cell.insert())
            step_s = 0.0
            monkeypatch.setattr(time, "time", lambda: real_s() + step_s)
            monkeypatch.setattr(time, "time_ns", lambda: int((real_s() + step_s) * 1e9))
            while not insertion.done():
                await asyncio.sleep(0.05)
                step_s = -3600.0 - step_s
            return await insertion

    state = asyncio.run(asyncio.wait_for(story(), 60.0))
    assert state.phase is Phase.INSERTED, state.reason
