"""`home`: references the gripper on an operator's command; only printed without --live."""

import asyncio

from robot_client.cli.terminal import DRY_RUN, Outcome, show, stop_on_signals, warning
from robot_client.interrupts import heed_interrupt
from robot_client.ports import DriverError, HomingDirection
from robot_client.session.runner import closed_after
from robot_client.settings import Settings


def home(settings: Settings, *, acknowledge: bool, direction: HomingDirection, live: bool) -> Outcome:
    """Reference the gripper, first acknowledging a latched fault on the operator's request; raises DriverError."""
    steps = (["acknowledge the latched fault"] if acknowledge else []) + [f"home {direction}"]
    way = f"connect to {settings.gripper.address} and {', then '.join(steps)}"
    if not live:
        show(DRY_RUN)
        show(f"would {way}")
        return Outcome(True, {"live": False, "steps": steps})
    show(warning(live=True, simulated=settings.simulated))
    show(f"will {way}: the fingers move, and drop a part that they do not feel")
    return asyncio.run(_home(settings, acknowledge=acknowledge, direction=direction))


async def _home(settings: Settings, *, acknowledge: bool, direction: HomingDirection) -> Outcome:
    stop_on_signals()
    async with closed_after(settings.make_gripper()) as gripper:
        try:
            await gripper.connect()
            heed_interrupt()
            if acknowledge:
                await gripper.acknowledge()
                heed_interrupt()
                show("gripper: fault acknowledged")
            width_mm = await gripper.home(direction)
            show(f"gripper: homed, width {width_mm:.1f} mm")
        except asyncio.CancelledError:
            raise DriverError("operator: interrupted, the gripper goes no further") from None
    return Outcome(True, {"live": True, "acknowledged": acknowledge, "width_mm": width_mm})
