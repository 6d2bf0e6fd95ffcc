"""Try an arm's driver in free air: it goes up, and part of that way down again, never lower than where it began."""

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from robot_client.insertion.events import Arrived, Event, Failure, Standstill, Stood
from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.lease import PAUSE_S, Lease
from robot_client.insertion.limits import LimitError, Limits, check_arrived, check_pose
from robot_client.insertion.motion import Ramps
from robot_client.insertion.state import Timeouts
from robot_client.interrupts import heed_interrupt, to_the_end
from robot_client.ports import NOT_CONFIRMED, Arm, DriverError, Finding
from robot_client.session.runner import close_arm

LEAST_UP_MM = 15.0
REST_MM = 0.05  # an arm that stands moves no further than this
_DESCENT_S = 0.5
_REST_S = 0.3
_SAMPLE_S = 0.002
_LEAST_POSES = 5  # on its way up; an arm that reports its way reports many more
_SPARE = 1.2  # of the room for all descents: a busy machine holds late
_SLOWER = 3.0  # in the second leg; an arm that knows no legs is soon far ahead there
_REPORT_S = 0.1  # age of a position that it reports


def up_mm(ramps: Ramps, lease: Lease, *, pauses: bool) -> float:
    """How far it goes up: it must arrive neither before its hold nor before the end of its lease."""
    longest_s = 2.0 * (_DESCENT_S + lease.stop_lag_s) + (2.0 * _DESCENT_S if pauses else 0.0)
    return max(LEAST_UP_MM, _SPARE * ramps.descend.speed_mm_s * longest_s)


@dataclass(slots=True)
class ArmTrial:
    """Each step shows whether one promise of the port :class:`Arm` is kept; one that breaks ends the try."""

    arm: Arm
    limits: Limits
    ramps: Ramps
    lease: Lease
    timeouts: Timeouts
    pauses: bool  # :attr:`DeviceSettings.pauses`
    _events: asyncio.Queue[Event] = field(default_factory=asyncio.Queue)

    async def run(self, show: Callable[[Finding], None]) -> None:
        """Raises DriverError if the arm is not ready or its stop not confirmed, LimitError if it has no room above."""
        try:
            self._holds_before_its_start(show)
            start = await self.arm.start(self._events.put_nowait)
            heed_interrupt()
            higher_mm = up_mm(self.ramps, self.lease, pauses=self.pauses)
            top = check_pose(self.limits, start.at_height(start.z_mm + higher_mm), f"{higher_mm:g} mm higher")
            try:
                show(await self._arrives(top))
                show(await self._stands_after_a_hold(start))
                if self.pauses:
                    show(await self._keeps_to_its_legs())
                show(await self._stands_without_a_lease(start))
                show(self._is_latched(start))
            except (DriverError, LimitError) as error:
                show(Finding(False, str(error)))
        finally:
            await to_the_end(close_arm(self.arm, lambda farewell: show(_closed(farewell))))

    def _holds_before_its_start(self, show: Callable[[Finding], None]) -> None:
        """As where the gripper fails first."""
        try:
            self.arm.hold("not started yet", stop=False)
        except Exception as error:
            show(Finding(False, f"hold before the start: {type(error).__name__}: {error}, expected no error"))

    async def _arrives(self, top: WorkPose) -> Finding:
        """It arrives where it was sent, and reports where it is on the way."""
        wait_s = 1.5 * self.ramps.duration_s(self._here(), top, "travel") + self.timeouts.motion_s
        self.arm.move(top, "travel")
        arriving = asyncio.ensure_future(self._next("move", wait_s))
        poses = set()
        while not arriving.done():
            poses.add(self._here())
            await asyncio.sleep(_SAMPLE_S)
        event = await arriving
        if not isinstance(event, Arrived):
            raise DriverError(f"move: {_text(event)}, expected arrived")
        check_arrived(top, event.pose)
        away_mm = self._here().distance_mm(event.pose)
        way = f"{len(poses)} positions on the way, expected {_LEAST_POSES} or more; the last is {away_mm:.2f} mm away"
        return Finding(len(poses) >= _LEAST_POSES and away_mm <= REST_MM, f"move: arrived; {way}")

    async def _stands_after_a_hold(self, bottom: WorkPose) -> Finding:
        """Its target freezes at once, and a standstill is one."""
        self.arm.move(bottom, "descend", time.monotonic() + 10.0 * _DESCENT_S)
        await asyncio.sleep(_DESCENT_S)
        before = self._here()
        self.arm.hold("a try", stop=False)
        event = await self._next("hold", self.timeouts.stopping_s)
        if not isinstance(event, Standstill):
            raise DriverError(f"hold: {_text(event)}, expected standstill")
        await asyncio.sleep(_REST_S)
        went_mm, after_mm = before.distance_mm(self._here()), event.pose.distance_mm(self._here())
        text = f"hold: went on by {went_mm:.2f} mm ({self._bound}), by {after_mm:.2f} mm after its standstill"
        return Finding(went_mm <= self._allowed_mm and after_mm <= REST_MM, f"{text} (allowed {REST_MM:g})")

    async def _keeps_to_its_legs(self) -> Finding:
        """In a descent with two speeds, whose lease is renewed on the way, it is where its time says."""
        start, speed_mm_s = self._here(), self.ramps.descend.speed_mm_s
        leg_mm, wait_s = speed_mm_s * _DESCENT_S, (1.0 + _SLOWER) * _DESCENT_S + self.timeouts.motion_s
        legs = (start.z_mm - leg_mm, speed_mm_s), (start.z_mm - 2.0 * leg_mm, speed_mm_s / _SLOWER)
        profile, begun_s = self.ramps.in_legs(start.z_mm, legs), time.monotonic()
        try:
            self.arm.move(start.at_height(legs[-1][0]), "descend", begun_s + _DESCENT_S, legs)
        except (TypeError, LimitError) as error:
            return Finding(False, f"legs: {type(error).__name__}: {error}, expected a descent with two speeds")
        arriving = asyncio.ensure_future(self._next("legs", wait_s))
        renewed, ahead_mm, behind_mm = False, 0.0, 0.0
        while not arriving.done():
            passed_s = time.monotonic() - begun_s
            if passed_s > 0.5 * _DESCENT_S and not renewed:
                self.arm.renew(begun_s + wait_s)
                renewed = True
            off_mm = start.z_mm - self._here().z_mm - profile.position(passed_s)
            ahead_mm, behind_mm = max(ahead_mm, off_mm), max(behind_mm, -off_mm)
            await asyncio.sleep(_SAMPLE_S)
        if not isinstance(event := await arriving, Arrived):
            raise DriverError(f"legs: {_text(event)}, expected arrived, as its lease was renewed")
        early_mm = speed_mm_s * _REPORT_S + REST_MM  # one that lags is behind; ahead is one that leaves a leg out
        late_mm = early_mm + speed_mm_s * self.lease.stop_lag_s
        text = f"legs: at most {ahead_mm:.2f} mm ahead of its time (allowed {early_mm:.2f})"
        text = f"{text}, {behind_mm:.2f} mm behind (allowed {late_mm:.2f})"
        return Finding(ahead_mm <= early_mm and behind_mm <= late_mm, text)

    async def _stands_without_a_lease(self, bottom: WorkPose) -> Finding:
        """It stands by itself where its lease ends, and fails if that is not renewed."""
        until_s = time.monotonic() + _DESCENT_S
        self.arm.move(bottom, "descend", until_s)
        await asyncio.sleep(max(0.0, until_s - time.monotonic()))
        before = self._here()
        event = await self._next("lease", 2.0 * PAUSE_S)
        await asyncio.sleep(_REST_S)
        went_mm = before.distance_mm(self._here())
        good = isinstance(event, Failure) and event.code == "unwatched" and went_mm <= self._allowed_mm
        return Finding(good, f"lease: went on by {went_mm:.2f} mm after its end ({self._bound}), then {_text(event)}")

    def _is_latched(self, target: WorkPose) -> Finding:
        try:
            self.arm.move(target, "travel")
        except LimitError as error:
            return Finding(True, f"after a failure: {error}")
        return Finding(False, "after a failure: takes another move, expected a LimitError")

    def _here(self) -> WorkPose:
        here = self.arm.position()
        if here is None:
            raise DriverError("position: None after the start, expected the measured pose")
        return here

    async def _next(self, order: str, within_s: float) -> Event:
        try:
            async with asyncio.timeout(within_s):
                while isinstance(event := await self._events.get(), Stood):
                    pass
        except TimeoutError:
            raise DriverError(f"{order}: no event followed within {within_s:.1f} s") from None
        return event

    @property
    def _allowed_mm(self) -> float:
        return self.ramps.descend.speed_mm_s * self.lease.stop_lag_s + REST_MM

    @property
    def _bound(self) -> str:
        return f"allowed {self._allowed_mm:.2f} with lease.stop_lag_s = {self.lease.stop_lag_s:g}"


def _closed(farewell: str) -> Finding:
    return Finding(not farewell.startswith(NOT_CONFIRMED), f"close: {farewell}")


def _text(event: Event) -> str:
    return f"failure {event.code}: {event.detail}" if isinstance(event, Failure) else event.kind
