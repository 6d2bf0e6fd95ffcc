"""The rehearsal: every order, limit and ramp of the real insertion, no device and no network.

The arm follows its targets exactly, faster than real time. Contact is plain geometry (an error larger than the
clearance blocks), and every decision is the true error times 0.7: what is shown are the motions that would be sent.
"""

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from robot_client.insertion.events import Arrived, Failure, FromService, Grasped, Standstill
from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.limits import LimitError, Limits, Motion
from robot_client.insertion.motion import CYCLE_S, MotionGuide, Ramps
from robot_client.ports import Post
from service.contract import wire

_CONTACT_MM = 6.0  # below the approach pose: 5 mm of air and what the pads give
_CLEARANCE_MM, _CLEARANCE_DEG = 2.0, 3.0
_SHARE = 0.7
_BATCH = 50


@dataclass(slots=True)
class DryArm:
    """Arm port without an arm."""

    limits: Limits
    ramps: Ramps
    start_pose: WorkPose
    on_target: Callable[[WorkPose], None] = lambda _pose: None
    _post: Post = field(init=False, repr=False)
    _guide: MotionGuide = field(init=False)
    _task: asyncio.Task[None] | None = None
    _cycles: int = 0

    async def start(self, post: Post) -> WorkPose:
        """Stand at the start pose."""
        self._post = post
        self._guide = MotionGuide(self.limits, self.ramps, self.start_pose)
        self._task = asyncio.get_running_loop().create_task(self._run())
        return self.start_pose

    def move(self, target: WorkPose, motion: Motion) -> None:
        """Begin a move; raises LimitError if it is not allowed."""
        self._guide.move(target, motion)

    def hold(self, reason: str, *, stop: bool) -> None:  # noqa: ARG002 the port's signature
        """Freeze the target."""
        self._guide.hold()

    async def close(self) -> str:
        """Nothing to stop."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)
        return "dry run: no controller"

    def position(self) -> WorkPose | None:
        """The target: the dry arm has no lag."""
        return self._guide.target

    def statistics(self) -> dict[str, Any]:
        """Cycles that were computed."""
        return {"dry_cycles": self._cycles}

    async def _run(self) -> None:
        while True:
            for _ in range(_BATCH):
                self._cycles += 1
                pose = self._advanced()
                self.on_target(pose)
                settled = self._guide.observe(pose, self._cycles * CYCLE_S)
                if settled:
                    event = Arrived if settled == "arrived" else Standstill
                    self._post(event(at_s=time.monotonic(), pose=pose))
                    break
            await asyncio.sleep(0.0 if self._guide.moving else 0.001)

    def _advanced(self) -> WorkPose:
        try:
            return self._guide.advance(CYCLE_S)
        except LimitError as error:  # what the real arm's driver would refuse
            self._guide.hold()
            self._post(Failure(at_s=time.monotonic(), source="arm", code="limits", detail=str(error)))
            return self._guide.target


@dataclass(slots=True)
class DryGripper:
    """Gripper port that holds."""

    width_mm: float = 50.0
    _post: Post = field(init=False, repr=False)

    async def start(self, post: Post) -> None:
        """Nothing to connect."""
        self._post = post

    def grasp(self) -> None:
        """Held at once."""
        asyncio.get_running_loop().call_soon(lambda: self._post(Grasped(at_s=time.monotonic(), width_mm=self.width_mm)))

    async def close(self) -> None:
        """Nothing to release."""


@dataclass(slots=True)
class DryService:
    """DecisionService port that knows the error it was given."""

    insertion_id: str
    limits: Limits
    approach_z_mm: float
    _post: Post = field(init=False, repr=False)
    _error: WorkPose | None = None
    _attempt: int = 0
    _watching: bool = False

    async def start(self, post: Post) -> None:
        """Nothing to connect."""
        self._post = post

    def watch(self, pose: WorkPose) -> None:
        """See where the arm is; contact above the gap's blocks is slip."""
        self._error = pose
        blocked = abs(pose.x_mm) > _CLEARANCE_MM or abs(pose.yaw_deg) > _CLEARANCE_DEG
        if self._watching and blocked and self.approach_z_mm - pose.z_mm >= _CONTACT_MM:
            self._watching = False
            self._tell(
                wire.Slip(
                    insertion_id=self.insertion_id,
                    attempt=self._attempt,
                    finger="left",
                    frame_seq=0,
                    captured_ns=0,
                    age_ms=0.0,
                    score=1.0,
                    reason="dry run: contact by geometry",
                )
            )

    def send(self, message: wire.ClientMessage) -> None:
        """Answer as the service would, on the next turn of the event loop."""
        asyncio.get_running_loop().call_soon(self._answer, message)

    async def close(self) -> None:
        """Nothing to close."""

    def _tell(self, message: wire.ServiceMessage) -> None:
        self._post(FromService(at_s=time.monotonic(), message=message))

    def _answer(self, message: wire.ClientMessage) -> None:
        match message:
            case wire.ClientHello():
                self._tell(self._hello())
            case wire.Arm():
                self._attempt, self._watching = message.attempt, True
                self._tell(wire.Armed(insertion_id=self.insertion_id, attempt=message.attempt, reference_seq=0))
            case wire.Stopped(outcome="inserted"):
                self._tell(wire.Finished(insertion_id=self.insertion_id, outcome="inserted", attempts=message.attempt))
            case wire.Stopped(outcome="blocked"):
                self._tell(self._correction(message.attempt))

    def _hello(self) -> wire.ServiceHello:
        bounds = wire.Limits(
            max_dx_mm=self.limits.max_dx_mm, max_dtheta_deg=self.limits.max_dtheta_deg, max_frame_age_ms=1000.0
        )
        return wire.ServiceHello(
            insertion_id=self.insertion_id, models=(), cameras=(), controller="heuristic", limits=bounds
        )

    def _correction(self, attempt: int) -> wire.Correction:
        assert self._error is not None
        x_mm, theta_deg = self._error.x_mm, self._error.yaw_deg
        return wire.Correction(
            insertion_id=self.insertion_id,
            attempt=attempt,
            dx_mm=-_SHARE * x_mm,
            dtheta_deg=-_SHARE * theta_deg,
            class_probabilities={},
            estimate=wire.Estimate(dx_mm=x_mm, dtheta_deg=theta_deg),
            confidence=1.0,
            controller="heuristic",
            reason="dry run: the true error times 0.7",
            latency_ms={},
        )
