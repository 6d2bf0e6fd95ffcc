"""`jog` and `home`: the two motions an operator orders by hand, both only shown unless --live is typed."""

import asyncio

from robot_client.cli.insert import NOT_A_SAFETY_FUNCTION, live_arm, stop_on_signals
from robot_client.grippers.wsg50.codec import HomingDirection
from robot_client.grippers.wsg50.driver import Wsg50
from robot_client.grippers.wsg50.text_driver import GclGripper
from robot_client.insertion.events import Arrived, Event, Failure
from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.limits import check_pose
from robot_client.insertion.motion import check_ramps
from robot_client.ports import Arm, DriverError
from robot_client.session.runner import to_the_end
from robot_client.settings import Settings


def jog(settings: Settings, target: WorkPose, *, live: bool) -> int:
    """Take the TCP to ``target``: up, over, down, all at travel speed; raises LimitError, DriverError."""
    check_pose(settings.limits, target)
    check_ramps(settings.limits, settings.ramps)
    if not live:
        print("DRY RUN: nothing is connected, nothing moves (type --live to move).")
        print(f"would go up or stay, over, then down to {_text(target)}; within the limits")
        return 0
    print(NOT_A_SAFETY_FUNCTION)
    return asyncio.run(_jog(settings, target))


async def _jog(settings: Settings, target: WorkPose) -> int:
    arm = live_arm(settings)
    events: asyncio.Queue[Event] = asyncio.Queue()
    here = None
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
    return 0


async def _end(arm: Arm) -> None:
    print(await arm.close())


def home(settings: Settings, *, acknowledge: bool, direction: HomingDirection, live: bool) -> int:
    """Reference the gripper, first acknowledging a latched fault if the operator says so; raises DriverError."""
    if not live:
        print("DRY RUN: nothing is connected, nothing moves (type --live to move).")
        steps = (["acknowledge the latched fault"] if acknowledge else []) + [f"home {direction.name.lower()}"]
        print(f"would connect to {settings.gripper.host}:{settings.gripper.port} and " + ", then ".join(steps))
        return 0
    print(NOT_A_SAFETY_FUNCTION)
    return asyncio.run(_home(settings, acknowledge=acknowledge, direction=direction))


async def _home(settings: Settings, *, acknowledge: bool, direction: HomingDirection) -> int:
    gripper = GclGripper(settings.gripper) if settings.gripper.protocol == "text" else Wsg50(settings.gripper)
    stop_on_signals()
    try:
        await gripper.connect()
        if acknowledge:
            await gripper.acknowledge()
            print("gripper: fault acknowledged")
        await gripper.home(direction)
        width_mm = gripper.width_mm if isinstance(gripper, GclGripper) else await gripper.width_mm()
        print(f"gripper: homed, width {width_mm:.1f} mm")
    except asyncio.CancelledError:
        raise DriverError("operator: interrupted, the gripper goes no further") from None
    finally:
        await to_the_end(gripper.close())
    return 0


def _text(pose: WorkPose) -> str:
    return f"x {pose.x_mm:+.2f}, y {pose.y_mm:+.2f}, z {pose.z_mm:+.2f} mm, yaw {pose.yaw_deg:+.2f} deg"
