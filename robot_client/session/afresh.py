"""An object that has turned in the hand goes back into its fixture, is picked upright, and the insertion continues."""

import secrets
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace

from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.limits import Motion
from robot_client.insertion.state import Plan, State
from robot_client.session.travel import Errands, over_to, straight_up


@dataclass(frozen=True, slots=True)
class Fixture:
    """Where objects are taken from. ``open_mm``: how far the fingers open there."""

    pick: WorkPose
    open_mm: float
    retreat_mm: float
    errands: Errands

    async def put_back(self, up: Motion = "retract") -> None:
        """Straight up, slowly from between the blocks, over, down, and open; raises DriverError, LimitError."""
        for way in (straight_up(self.retreat_mm, up), over_to(self.pick)):
            await self.errands.go(way)
        await self.errands.with_gripper(lambda gripper: gripper.release(self.open_mm))


async def upright(
    plan: Plan, run: Callable[[Plan], Awaitable[State]], fixture: Fixture | None, show: Callable[[str], None]
) -> State:
    """Run an insertion, again with the object regrasped as often as it has turned in the hand.

    The state at the end counts the attempts of all of them; together they are no more than the plan allows. Without a
    fixture the first one is the last. Raises DriverError or LimitError where the arm cannot get there.
    """
    plan, tried_n = plan.model_copy(update={"fixture": fixture is not None}), 0
    while True:
        state = await run(plan)
        again = state.afresh(new_id()) if fixture else None
        if fixture is None or again is None:
            return replace(state, attempt=tried_n + state.attempt)
        show("back to the fixture, to be taken upright")
        tried_n += state.tried_n
        await fixture.put_back("travel" if state.tried_n < state.attempt else "retract")
        plan = again


def new_id() -> str:
    return f"{time.strftime('%Y%m%d-%H%M%S')}-{secrets.token_hex(3)}"
