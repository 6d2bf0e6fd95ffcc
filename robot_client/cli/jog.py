"""`jog`: moves the arm to a pose on an operator's command; only printed without --live."""

import asyncio

from robot_client.cli.terminal import DRY_RUN, Outcome, show, stop_on_signals, warning
from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.limits import check_pose
from robot_client.insertion.motion import check_ramps
from robot_client.session.travel import over_to, pose_text
from robot_client.settings import Settings


def jog(settings: Settings, target: WorkPose, *, live: bool) -> Outcome:
    """Move the TCP to ``target``: up, over, down, all at travel speed; raises LimitError, DriverError."""
    check_pose(settings.limits, target)
    check_ramps(settings.limits, settings.ramps)
    if not live:
        print(DRY_RUN)
        print(f"would go up or stay, over, then down to {pose_text(target)}; within the limits")
        return Outcome(True, {"live": False, "target": target.model_dump()})
    show(warning(live=True, simulated=settings.simulated))
    return asyncio.run(_jog(settings, target))


async def _jog(settings: Settings, target: WorkPose) -> Outcome:
    stop_on_signals()
    here = await settings.errands.go(over_to(target, target.z_mm), show)
    show(f"at   {pose_text(here)}")
    return Outcome(True, {"live": True, "target": target.model_dump(), "pose": here.model_dump()})
