"""The rehearsal: every order, limit and ramp of the real insertion, no device and no network.

The arm follows its targets exactly, faster than real time. Contact is plain geometry (an error larger than the
clearance blocks), and every decision is the true error times 0.7: the motions shown are those of a live run.
"""

import asyncio
import time
from dataclasses import dataclass, field

from robot_client.grippers.dry_run.driver import DryGripper
from robot_client.insertion.events import FromService
from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.limits import Limits
from robot_client.insertion.state import Plan
from robot_client.ports import Arm, DecisionService, Gripper, Post
from robot_client.robots.dry_run.driver import DryArm, Settings
from service.contract import wire
from service.contract.replies import clock

_CONTACT_MM = 6.0  # below the approach pose: 5 mm of air and the pads' compliance
_CLEARANCE_MM, _CLEARANCE_DEG = 2.0, 3.0
_SHARE = 0.7
_CYCLES_A_FRAME = 8  # 30 frames per second of the rehearsed arm


def rehearsal_ports(plan: Plan) -> tuple[Arm, Gripper, DecisionService]:
    """Ports that start 40 mm above the approach pose and know the start error."""
    service = DryService(plan.insertion_id, plan.limits, plan.approach.z_mm)
    start = plan.approach.at_height(plan.approach.z_mm + 40.0)
    arm = DryArm(plan.limits, plan.ramps, Settings(start=start), on_target=service.watch)
    return arm, DryGripper(), service


@dataclass(slots=True)
class DryService:
    """DecisionService port that knows the true error: it reads the arm's pose."""

    insertion_id: str
    limits: Limits
    approach_z_mm: float
    _post: Post = field(init=False, repr=False)
    _error: WorkPose | None = None
    _attempt: int = 0
    _watching: bool = False
    _targets_n: int = 0

    async def start(self, post: Post) -> None:
        self._post = post

    def watch(self, pose: WorkPose) -> None:
        """Take the arm's pose; contact with the blocks is slip."""
        self._error = pose
        self._targets_n += 1
        if self._watching and self._targets_n % _CYCLES_A_FRAME == 0:
            now_ns = time.monotonic_ns()
            self._send(
                wire.Watching(
                    insertion_id=self.insertion_id, attempt=self._attempt, frame_captured_ns=now_ns, judged_ns=now_ns
                )
            )
        blocked = abs(pose.x_mm) > _CLEARANCE_MM or abs(pose.yaw_deg) > _CLEARANCE_DEG
        if self._watching and blocked and self.approach_z_mm - pose.z_mm >= _CONTACT_MM:
            self._watching = False
            self._send(
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

    def _send(self, message: wire.ServiceMessage) -> None:
        self._post(FromService(at_s=time.monotonic(), message=message))

    def _answer(self, message: wire.ClientMessage) -> None:
        match message:
            case wire.ClientHello():
                self._send(self._hello(message))
            case wire.LearnOpen():
                self._send(wire.OpenLearnt(insertion_id=self.insertion_id))
            case wire.Arm():
                self._attempt, self._watching = message.attempt, True
                named, now_ns = self.insertion_id, time.monotonic_ns()
                self._send(
                    wire.Armed(insertion_id=named, attempt=message.attempt, reference_seq=0, frame_captured_ns=now_ns)
                )
            case wire.Stopped(outcome="inserted"):
                self._watching = False
                self._send(wire.Finished(insertion_id=self.insertion_id, outcome="inserted", attempts=message.attempt))
            case wire.Stopped(outcome="blocked"):
                self._send(self._correction(message.attempt))

    def _hello(self, message: wire.ClientHello) -> wire.ServiceHello:
        bounds = wire.Limits(
            max_dx_mm=self.limits.max_dx_mm, max_dtheta_deg=self.limits.max_dtheta_deg, max_frame_age_ms=1000.0
        )
        return wire.ServiceHello(
            insertion_id=self.insertion_id,
            clock=clock(message, message.sent_ns or time.monotonic_ns()),  # one process, one clock: no offset
            models=(),
            cameras=(),
            controller="heuristic",
            limits=bounds,
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
