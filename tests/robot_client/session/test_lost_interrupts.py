"""A driver from elsewhere loses an interrupt, as `wait_for` does up to Python 3.11: nothing is ordered after it."""

import asyncio
import contextlib
from types import SimpleNamespace

import pytest

from robot_client.cli import home
from robot_client.grippers.dry_run.driver import DryGripper
from robot_client.ports import DriverError
from robot_client.session.travel import Errands
from robot_client.session.trial.arm import ArmTrial
from robot_client.session.trial.gripper import try_empty
from tests.robot_client.insertion.stories import PLAN
from tests.robot_client.session.test_runner import Port


async def lose_an_interrupt():
    asyncio.current_task().cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await asyncio.sleep(0)


def gripper_that_loses_it(orders, at):
    class Losing(DryGripper):
        async def connect(self):
            await self._note("connect")

        async def start(self, post):
            await super().start(post)
            await self._note("start")

        async def acknowledge(self):
            await self._note("acknowledge")

        async def release(self, _width_mm):
            await self._note("release")

        async def home(self, _direction):
            await self._note("home")

        def grasp(self):
            orders.append("grasp")

        async def _note(self, order):
            orders.append(order)
            if order == at:
                await lose_an_interrupt()

        async def width_mm(self):
            return 80.0

    return Losing


async def a_homing(make, *, acknowledge=True):
    await home._home(SimpleNamespace(make_gripper=make), acknowledge=acknowledge, direction="default")


async def an_errand(make):
    await Errands(None, make, *(None,) * 2, 1.0, 35.0).with_gripper(lambda gripper: gripper.release(80.0))


async def a_try(make):
    await try_empty(make, 0.1, lambda _finding: None)


@pytest.mark.parametrize(
    ("story", "at", "ordered"),
    [
        (an_errand, "connect", ["connect"]),
        (a_homing, "connect", ["connect"]),
        (a_homing, "acknowledge", ["connect", "acknowledge"]),
        (a_try, "connect", ["connect"]),
        (a_try, "start", ["connect", "start"]),
    ],
)
async def test_a_gripper_gets_no_order_after_it(story, at, ordered):
    orders = []
    (ended,) = await asyncio.gather(story(gripper_that_loses_it(orders, at)), return_exceptions=True)
    assert isinstance(ended, asyncio.CancelledError | DriverError)
    assert "interrupted" in str(ended) or isinstance(ended, asyncio.CancelledError)
    assert orders == ordered


async def test_an_arm_on_trial_does_not_move_after_it():
    moves, arm = [], Port("arm", [])
    arm.closing.set()

    async def start(_post):
        await lose_an_interrupt()
        return PLAN.approach

    arm.start, arm.move = start, lambda *move: moves.append(move)
    trial = ArmTrial(arm, PLAN.limits, PLAN.ramps, PLAN.lease, PLAN.timeouts, False)
    (ended,) = await asyncio.gather(trial.run(lambda _finding: None), return_exceptions=True)
    assert isinstance(ended, asyncio.CancelledError)
    assert moves == []
