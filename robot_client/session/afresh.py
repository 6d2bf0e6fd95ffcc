"""Regrasp: an object turned in the hand goes back into its fixture, is picked upright, and the insertion continues."""

import secrets
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace

from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.limits import Motion
from robot_client.insertion.state import Plan, State
from robot_client.session.travel import Errands, over_to


@dataclass(frozen=True, slots=True)
class Fixture:
    """The fixture of the objects. ``open_mm``: opening of the fingers there."""

    pick: WorkPose
    open_mm: float
    retreat_mm: float
    errands: Errands

    async def put_back(self, up: Motion = "retract") -> None:
        """Straight up, slowly from between the blocks, over, down, and open; raises DriverError, LimitError."""
        await self.errands.go(over_to(self.pick, max(self.errands.clear_mm, self.pick.z_mm + self.retreat_mm), up))
        await self.errands.with_gripper(lambda gripper: gripper.release(self.open_mm))


async def upright(
    plan: Plan, run: Callable[[Plan], Awaitable[State]], fixture: Fixture | None, show: Callable[[str], None]
) -> State:
    """Run an insertion, regrasping the object as often as it has turned in the hand.

    The final state counts the attempts of all of them; together they stay within the plan's limit. Without a fixture
    there is only the first one. Raises DriverError or LimitError if the arm cannot get there.
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
    """Its time is in UTC, as in the log and in the names of recordings."""
    return f"{time.strftime('%Y%m%d-%H%M%S', time.gmtime())}-{secrets.token_hex(3)}"
