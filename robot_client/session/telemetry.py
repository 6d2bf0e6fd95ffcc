"""The robot's motion, for the service's recording of the episode: sampled 50 times per second, in small batches."""

import platform
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.state import Plan, State
from robot_client.ports import Arm
from service import __version__
from service.contract import wire

BATCH_N = 5  # samples; at 50 per second, a crash loses a tenth of a second


@dataclass(slots=True)
class Telemetry:
    """Samples of the arm and the gripper; ``send`` queues a message and never waits, so no motion is delayed."""

    plan: Plan
    arm: Arm
    send: Callable[[wire.ClientMessage], None]
    simulated: bool | None = None
    _samples: list[wire.RobotSample] = field(default_factory=list)

    def begin(self, start: WorkPose) -> None:
        """Send the task, the start and the client's version."""
        plan = self.plan
        episode = wire.Episode(
            insertion_id=plan.insertion_id,
            purpose=plan.purpose,
            simulated=self.simulated,
            object=plan.object,
            start=pose(start),
            approach=pose(plan.approach),
            starts=tuple(map(pose, plan.starts)),
            versions={"client": __version__, "protocol": str(wire.PROTOCOL), "python": platform.python_version()},
        )
        self.send(episode)

    def sample(self, state: State, width_mm: float | None) -> None:
        """Take one sample; every fifth sends them."""
        measured, commanded = self.arm.position(), self.arm.target()
        deep = None if measured is None or state.armed is None else state.armed.z_mm - measured.z_mm
        self._samples.append(
            wire.RobotSample(
                at_ns=time.monotonic_ns(),
                phase=str(state.phase),
                attempt=state.attempt,
                commanded=None if commanded is None else pose(commanded),
                measured=None if measured is None else pose(measured),
                depth_mm=deep,
                width_mm=width_mm,
            )
        )
        if len(self._samples) >= BATCH_N:
            self.flush()

    def flush(self) -> None:
        """Send the pending samples, before a message that may end the insertion."""
        if self._samples:
            taken, self._samples = tuple(self._samples), []
            named, now_ns = self.plan.insertion_id, time.monotonic_ns()
            self.send(wire.Telemetry(insertion_id=named, sent_ns=now_ns, samples=taken))


def pose(of: WorkPose) -> wire.ToolPose:
    return wire.ToolPose(**of.model_dump())
