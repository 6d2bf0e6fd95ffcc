"""The insertion under way, as the page shows it."""

import time
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from service.contract import wire
from service.decision.controllers import Command
from service.web.page.sentences import shift, sure

GHOSTS_N = 24
ANSWERED = {"no_decision", "refused"}  # a person has to read why: shown until the next attempt


@dataclass(slots=True)
class Running:
    """State of one insertion; poses are (x mm, yaw deg) of the object relative to the gap, None: unknown.

    ``ghosts`` are poses drawn from the belief, evenly by probability: the closer together, the more certain. ``target``
    is the destination of the move. ``afresh_n``: number of regrasps, after ``earlier_n`` attempts in all, which
    ``attempt`` includes; ``descended_n``: all those that went down, once it has ended. ``depth_mm``: below the start of
    the descent. ``began_s``: on the steady clock of the service.
    """

    insertion_id: str
    began_s: float = field(default_factory=time.monotonic)
    phase: str = "start"
    attempt: int = 0
    afresh_n: int = 0
    earlier_n: int = 0
    descended_n: int = 0
    object: str = ""
    gap_width_mm: float | None = None
    width_mm: float | None = None
    depth_mm: float | None = None
    expected_depth_mm: float | None = None
    pose: tuple[float, float] | None = None
    target: tuple[float, float] | None = None
    ghosts: list[tuple[float, float]] = field(default_factory=list)
    move: dict[str, Any] | None = None
    problem: str = ""

    @property
    def most_n(self) -> int:
        """Attempts at most; a controller of somebody else's may allow more, over several grasps."""
        return max(wire.MAX_ATTEMPTS, self.attempt)

    def goes_on(self, insertion_id: str) -> "Running":
        """The insertion that continues with this one's object; an attempt that did not go down does not count."""
        again = replace(self, insertion_id=insertion_id, phase="start", problem="", depth_mm=None)
        again.afresh_n, again.attempt, again.earlier_n = self.afresh_n + 1, self.descended_n, self.descended_n
        return again

    def from_client(self, message: Any) -> None:
        match message:
            case wire.Episode():
                self.object = message.object.replace("_", " ")
            case wire.Arm():
                self.phase, self.attempt, self.problem = "arming", self.earlier_n + message.attempt, ""
                self.gap_width_mm, self.expected_depth_mm = message.gap_width_mm, message.expected_depth_mm
                self.width_mm = message.gripper_width_mm or self.width_mm
                self.depth_mm = 0.0
                self._moved()
            case wire.Descending():
                self.phase = "descending"
            case wire.Stopped():
                self.phase = "closing" if message.outcome == "inserted" else "deciding"
                self.depth_mm = message.depth_mm
            case wire.Abort():
                self.problem = message.reason

    def robot(self, sample: wire.RobotSample) -> None:
        if sample.phase in {"inserted", "failed"}:
            return
        self.phase = self.phase if self.phase in ANSWERED else sample.phase
        self.width_mm = sample.width_mm if sample.width_mm is not None else self.width_mm
        self.depth_mm = sample.depth_mm if sample.depth_mm is not None else self.depth_mm

    def from_service(self, message: Any) -> None:
        match message:
            case wire.Armed():
                self.phase = "armed"
            case wire.Straighten():
                self.phase = "correcting"
            case wire.Slip() | wire.Enough():
                self.phase = "stopping"
            case wire.Correction():
                self._corrected(message)
            case wire.NoDecision() | wire.Refused():
                self.phase, self.problem = message.type, message.detail
            case wire.Fault():
                self.problem = message.detail

    def believes(self, command: Command) -> None:
        belief = command.belief
        if belief is None:
            return
        share = np.cumsum(belief.probability.ravel())
        picked = np.searchsorted(share, (np.arange(GHOSTS_N) + 0.5) / GHOSTS_N * share[-1])
        rows, columns = np.unravel_index(np.minimum(picked, share.size - 1), belief.probability.shape)
        poses = zip(belief.x_mm[rows], belief.theta_deg[columns], strict=True)
        self.ghosts = [(round(float(x), 2), round(float(theta), 2)) for x, theta in poses]

    def _corrected(self, message: wire.Correction) -> None:
        felt = message.estimate
        self.phase, self.problem = "correcting", ""
        self.pose = felt.dx_mm, felt.dtheta_deg
        self.target = felt.dx_mm + message.dx_mm, felt.dtheta_deg + message.dtheta_deg
        self.move = {
            "attempt": message.attempt,
            "dx_mm": message.dx_mm,
            "dtheta_deg": message.dtheta_deg,
            "words": shift(message.dx_mm, message.dtheta_deg),
            "felt": shift(felt.dx_mm, felt.dtheta_deg),
            "confidence": message.confidence,
            "sure": sure(message.confidence),
        }

    def _moved(self) -> None:
        """Apply the move: the object is at its destination, with unchanged certainty."""
        if self.pose is None or self.target is None:
            return
        dx, dtheta = self.target[0] - self.pose[0], self.target[1] - self.pose[1]
        self.ghosts = [(round(x + dx, 2), round(theta + dtheta, 2)) for x, theta in self.ghosts]
        self.pose, self.target = self.target, None
