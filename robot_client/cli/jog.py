"""`jog`: moves the arm to a pose on an operator's command; only printed without --live."""

import asyncio

from robot_client.cli.terminal import DRY_RUN, Outcome, show, stop_on_signals, warning
from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.limits import check_pose
from robot_client.insertion.motion import check_ramps
from robot_client.session.travel import over_to, pose_text
from robot_client.settings import Settings


def jog(settings: Settings, target: WorkPose, *, live: bool) -> Outcome:
    """Move the TCP to ``target``: up as slowly as from between blocks, over, down; raises LimitError, DriverError."""
    check_pose(settings.limits, target)
    check_pose(settings.limits, target.at_height(max(target.z_mm, _clear_mm(settings))), "above target")
    check_ramps(settings.limits, settings.ramps)
    way = f"go up to z {_clear_mm(settings):+.2f} mm at least, over, then down to {pose_text(target)}"
    if not live:
        show(DRY_RUN)
        show(f"would {way}; within the limits")
        return Outcome(True, {"live": False, "target": target.model_dump()})
    show(warning(live=True, simulated=settings.simulated))
    show(f"will {way}, at up to {settings.ramps.unwatched_mm_s:g} mm/s and with no watch for touch")
    return asyncio.run(_jog(settings, target))


async def _jog(settings: Settings, target: WorkPose) -> Outcome:
    stop_on_signals()
    here = await settings.errands.go(over_to(target, _clear_mm(settings), "retract"), show)
    show(f"at   {pose_text(here)}")
    return Outcome(True, {"live": True, "target": target.model_dump(), "pose": here.model_dump()})


def _clear_mm(settings: Settings) -> float:
    """From here on the arm goes sideways: above the blocks, and above what stands at a taught pose."""
    taught, heights_mm = settings.cycle, [settings.errands.clear_mm]
    if taught is not None:
        heights_mm += [taught.above(pose).z_mm for pose in (taught.pick, taught.reject) if pose is not None]
    return max(heights_mm)
