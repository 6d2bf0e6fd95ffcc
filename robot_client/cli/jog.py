"""`jog`: takes the arm to a pose on an operator's command; only shown unless --live is typed."""

import asyncio

from robot_client.cli.terminal import DRY_RUN, NOT_A_SAFETY_FUNCTION, Outcome, show, stop_on_signals
from robot_client.insertion.events import Arrived, Event, Failure
from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.limits import check_pose
from robot_client.insertion.motion import check_ramps
from robot_client.ports import Arm, DriverError
from robot_client.session.runner import to_the_end
from robot_client.settings import Settings


def jog(settings: Settings, target: WorkPose, *, live: bool) -> Outcome:
    """Take the TCP to ``target``: up, over, down, all at travel speed; raises LimitError, DriverError."""
    check_pose(settings.limits, target)
    check_ramps(settings.limits, settings.ramps)
    if not live:
        print(DRY_RUN)
        print(f"would go up or stay, over, then down to {_text(target)}; within the limits")
        return Outcome(True, {"live": False, "target": target.model_dump()})
    print(NOT_A_SAFETY_FUNCTION)
    return asyncio.run(_jog(settings, target))


async def _jog(settings: Settings, target: WorkPose) -> Outcome:
    arm = settings.make_arm()
    events: asyncio.Queue[Event] = asyncio.Queue()
    stop_on_signals()
    try:
        here = await arm.start(events.put_nowait)
        print(f"from {_text(here)}")
        height_mm = max(here.z_mm, target.z_mm)
        for corner in (here.at_height(height_mm), target.at_height(height_mm), target):
            arm.move(corner, "travel")
            wait_s = 1.5 * settings.ramps.duration_s(here, corner, "travel") + settings.timeouts.motion_s
            event = await asyncio.wait_for(events.get(), wait_s)
            if isinstance(event, Failure):
                raise DriverError(f"{event.source}: {event.code}: {event.detail}")
            assert isinstance(event, Arrived)
            here = event.pose
    except TimeoutError:
        raise DriverError("robot: the arm did not arrive in time") from None
    except asyncio.CancelledError:
        raise DriverError("operator: interrupted, the arm is stopped") from None
    finally:
        await to_the_end(_end(arm))
    print(f"at   {_text(here)}")
    return Outcome(True, {"live": True, "target": target.model_dump(), "pose": here.model_dump()})


async def _end(arm: Arm) -> None:
    show(await arm.close())


def _text(pose: WorkPose) -> str:
    return f"x {pose.x_mm:+.2f}, y {pose.y_mm:+.2f}, z {pose.z_mm:+.2f} mm, yaw {pose.yaw_deg:+.2f} deg"
