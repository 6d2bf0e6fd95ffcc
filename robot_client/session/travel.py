"""Taking the arm somewhere outside an insertion: one connection, straight lines in free air, then a stop."""

import asyncio
from collections.abc import Callable, Sequence

from robot_client.insertion.events import Arrived, Event, Failure
from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.limits import Limits, Motion, check_pose
from robot_client.insertion.motion import Ramps
from robot_client.ports import Arm, DriverError
from robot_client.session.runner import to_the_end

Way = Callable[[WorkPose], Sequence[tuple[WorkPose, Motion]]]
"""The corners from where the arm stands, and how to go to each."""


def over_to(target: WorkPose) -> Way:
    """Up or stay, over, then down: never sideways down low."""

    def way(here: WorkPose) -> Sequence[tuple[WorkPose, Motion]]:
        height_mm = max(here.z_mm, target.z_mm)
        return [(here.at_height(height_mm), "travel"), (target.at_height(height_mm), "travel"), (target, "travel")]

    return way


def straight_up(by_mm: float, motion: Motion = "retract") -> Way:
    """Up along the vertical; slowly, from between what was let go of."""
    return lambda here: [(here.at_height(here.z_mm + by_mm), motion)]


async def travel(
    arm: Arm,
    way: Way,
    limits: Limits,
    ramps: Ramps,
    motion_s: float,
    show: Callable[[str], None],
    tell: Callable[[str], None] = lambda _how: None,
) -> WorkPose:
    """Start the arm, go the way, and close it whatever happens; returns where it stands then, measured.

    ``motion_s`` is added to what each line is planned to take; ``show`` is told where it begins, ``tell`` how it ended.
    Raises LimitError before anything moves if a corner is not allowed, DriverError if the arm fails or is interrupted.
    """
    events: asyncio.Queue[Event] = asyncio.Queue()
    interrupted = False
    try:
        here = await arm.start(events.put_nowait)
        show(f"from {pose_text(here)}")
        corners = way(here)
        for corner, _ in corners:
            check_pose(limits, corner)
        for corner, motion in corners:
            arm.move(corner, motion)
            wait_s = 1.5 * ramps.duration_s(here, corner, motion) + motion_s
            event = await asyncio.wait_for(events.get(), wait_s)
            if isinstance(event, Failure):
                raise DriverError(f"{event.source}: {event.code}: {event.detail}")
            assert isinstance(event, Arrived)
            here = event.pose
    except TimeoutError:
        raise DriverError("robot: the arm did not arrive in time") from None
    except asyncio.CancelledError:
        interrupted = True
        raise DriverError("operator: interrupted, the arm is stopped") from None
    finally:
        await to_the_end(_end(arm, tell), interrupted=interrupted)
    return here


async def _end(arm: Arm, tell: Callable[[str], None]) -> None:
    tell(await arm.close())


def pose_text(pose: WorkPose) -> str:
    return f"x {pose.x_mm:+.2f}, y {pose.y_mm:+.2f}, z {pose.z_mm:+.2f} mm, yaw {pose.yaw_deg:+.2f} deg"
