"""Motions outside an insertion: the arm moves along straight lines in free air, the gripper does one thing."""

import asyncio
import itertools
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass

from robot_client.insertion.events import Arrived, Event, Failure
from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.limits import LimitError, Limits, Motion, check_arrived, check_pose
from robot_client.insertion.motion import Ramps, check_ramps
from robot_client.interrupts import heed_interrupt, to_the_end
from robot_client.ports import NOT_CONFIRMED, Arm, DriverError, Gripper
from robot_client.session.runner import closed_after, farewell_of
from service.contract.refusals import reason

_INTERRUPTED = "operator: interrupted, the arm is stopped"
Way = Callable[[WorkPose], Sequence[tuple[WorkPose, Motion]]]
"""The corners from the arm's present pose, and the motion to each."""


def over_to(target: WorkPose, clear_mm: float, up: Motion = "travel") -> Way:
    """Up to ``clear_mm`` at least, over, then down: never sideways near the blocks or into a fixture."""

    def way(here: WorkPose) -> Sequence[tuple[WorkPose, Motion]]:
        height_mm = max(here.z_mm, target.z_mm, clear_mm)
        return [(here.at_height(height_mm), up), (target.at_height(height_mm), "travel"), (target, "travel")]

    return way


def straight_up(by_mm: float) -> Way:
    """Up along the vertical; slowly, away from a released object."""
    return lambda here: [(here.at_height(here.z_mm + by_mm), "retract")]


@dataclass(frozen=True, slots=True)
class Errands:
    """Motions of arm and gripper outside an insertion; each errand connects, does one thing and always closes.

    ``motion_s`` is added to the planned time of each line of a way. ``clear_mm``: height from which on nothing of the
    gap is in the way sideways.
    """

    make_arm: Callable[[], Arm]
    make_gripper: Callable[[], Gripper]
    limits: Limits
    ramps: Ramps
    motion_s: float
    clear_mm: float

    async def go(self, way: Way, show: Callable[[str], None] = lambda _text: None) -> WorkPose:
        """Follow the way; returns the arm's final pose, measured. ``show`` prints its start and its end.

        Raises LimitError before anything moves if a corner or a ramp is not allowed, DriverError if the arm fails or is
        interrupted: with how its controller was left.
        """
        check_ramps(self.limits, self.ramps)
        arm, here = self.make_arm(), None
        failed: Exception | None = None
        try:
            here = await self._follow(arm, way, show)
        except TimeoutError:
            failed = DriverError("robot: the arm did not arrive in time")
        except asyncio.CancelledError:
            failed = DriverError(_INTERRUPTED)
        except Exception as error:
            failed = error
        await to_the_end(_leave(arm, show, failed), interrupted=failed is not None)
        if failed:
            raise failed
        assert here is not None
        return here

    async def _follow(self, arm: Arm, way: Way, show: Callable[[str], None]) -> WorkPose:
        events: asyncio.Queue[Event] = asyncio.Queue()
        here = await arm.start(events.put_nowait)
        show(f"from {pose_text(here)}")
        corners = way(here)
        for before, corner in itertools.pairwise((here, *(corner for corner, _ in corners))):
            check_pose(self.limits, corner, here=before)
        for number, (corner, motion) in enumerate(corners):
            heed_interrupt()
            _begin_line(arm, corner, motion, begun=number > 0 or not events.empty())
            wait_s = 1.5 * self.ramps.duration_s(here, corner, motion) + self.motion_s
            event = await asyncio.wait_for(events.get(), wait_s)
            if isinstance(event, Failure):
                raise DriverError(f"{event.source}: {event.code}: {event.detail}")
            if not isinstance(event, Arrived):
                raise DriverError(f"robot: answered a move with {event.kind}, expected arrived")
            _check_arrived(corner, event.pose)
            here = event.pose
        heed_interrupt()
        return here

    async def with_gripper(self, work: Callable[[Gripper], Awaitable[float | bool]]) -> bool:
        """Connect the gripper, do the work, close; returns the work's answer as bool.

        Raises DriverError if the gripper fails, or is interrupted: its fingers may stand half open then.
        """
        async with closed_after(self.make_gripper()) as gripper:
            try:
                await gripper.connect()
                heed_interrupt()
                return bool(await work(gripper))
            except asyncio.CancelledError:
                raise DriverError(
                    "operator: interrupted while the fingers moved: look where they stand, and whether they still hold"
                ) from None


async def _leave(arm: Arm, show: Callable[[str], None], failed: Exception | None) -> None:
    """Close the arm; where it ``failed``, or its stop is not confirmed, raise DriverError with all of it."""
    farewell = await farewell_of(arm)
    show(farewell)
    moves, why = farewell.startswith(NOT_CONFIRMED), ""
    if failed:
        why = "operator: interrupted; " if moves and str(failed) == _INTERRUPTED else f"{reason(failed)}; "
    if moves or isinstance(failed, DriverError):
        raise DriverError(f"{why}robot: {farewell}")


def _begin_line(arm: Arm, corner: WorkPose, motion: Motion, *, begun: bool) -> None:
    """``begun``: the arm has moved, or reported something; it refuses an order now because it has failed."""
    try:
        arm.move(corner, motion)
    except LimitError as error:
        if not begun:
            raise
        raise DriverError(f"robot: {error}") from None


def _check_arrived(target: WorkPose, pose: WorkPose) -> None:
    try:
        check_arrived(target, pose)
    except LimitError as error:
        raise DriverError(f"robot: {error}") from None


def pose_text(pose: WorkPose) -> str:
    return f"x {pose.x_mm:+.2f}, y {pose.y_mm:+.2f}, z {pose.z_mm:+.2f} mm, yaw {pose.yaw_deg:+.2f} deg"
