"""An object that has turned in the hand goes back into its fixture, is taken upright, and the insertion goes on."""

import secrets
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace

from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.limits import Limits
from robot_client.insertion.motion import Ramps
from robot_client.insertion.state import Plan, State
from robot_client.ports import Arm, Gripper
from robot_client.session.runner import to_the_end
from robot_client.session.travel import over_to, travel


@dataclass(frozen=True, slots=True)
class Fixture:
    """Where objects are taken from, and what it takes to get there. ``open_mm``: how far the fingers open there."""

    pick: WorkPose
    open_mm: float
    make_arm: Callable[[], Arm]
    make_gripper: Callable[[], Gripper]
    limits: Limits
    ramps: Ramps
    motion_s: float

    async def open(self) -> None:
        """Open the fingers where the arm stands; raises DriverError."""
        gripper = self.make_gripper()
        try:
            await gripper.connect()
            await gripper.release(self.open_mm)
        finally:
            await to_the_end(gripper.close())

    async def approach(self) -> None:
        """Over to the fixture and down; raises DriverError, LimitError."""
        await travel(self.make_arm(), over_to(self.pick), self.limits, self.ramps, self.motion_s, lambda _text: None)

    async def put_back(self) -> None:
        """Stand the object in its fixture and open; raises DriverError, LimitError."""
        await self.approach()
        await self.open()


async def upright(
    plan: Plan, run: Callable[[Plan], Awaitable[State]], fixture: Fixture | None, show: Callable[[str], None]
) -> State:
    """Run an insertion, again with the object taken afresh as often as it has turned in the hand.

    The state at the end counts the attempts of all of them; together they are no more than the plan allows. Without a
    fixture the first one is the last. Raises DriverError or LimitError where the arm cannot get there.
    """
    tried_n = 0
    while True:
        state = await run(plan)
        again = state.afresh(new_id()) if fixture else None
        if fixture is None or again is None:
            return replace(state, attempt=tried_n + state.attempt)
        show("back to the fixture, to be taken upright")
        tried_n += state.attempt - 1
        await fixture.put_back()
        plan = again


def new_id() -> str:
    """A name for an insertion, by the time."""
    return f"{time.strftime('%Y%m%d-%H%M%S')}-{secrets.token_hex(3)}"
