"""The closed loop faster than real time: the service's own session and the robot client's own state machine.

`python -m simulation evaluate` runs the paper's test protocol in lock step: rendered frames go through the service's
perception, the shipped ONNX files and its controller; what it answers goes through the client's insertion machine.
This is the one module of the simulator that imports them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from robot_client.events import Arrived, Begin, Command, Event, FromService, Grasp, Grasped, Hold, Move, Say, Standstill
from robot_client.events import Tick as ClientTick
from robot_client.geometry import WorkPose
from robot_client.insertion import step
from robot_client.insertion_state import Phase, Plan, State
from service.contract import FINGERS
from service.contract.wire import ControllerName, Correction, NoDecision
from service.finger import TactileFinger
from service.insertion_session import InsertionSession
from service.models import ModelSet
from service.perception.rectify import CameraCalibration
from simulation.lockstep import LockstepCell
from simulation.scene import load_scene

MAX_FRAMES = 4000
Override = Callable[[int, tuple[float, float]], tuple[float, float]]


@dataclass(slots=True)
class Outcome:
    """One insertion: what was tried and how it ended. Errors are (x mm, theta deg) of the object before an attempt."""

    inserted: bool
    attempts: int
    reason: str
    final_error: tuple[float, float]
    block_motion_mm: float
    block_tilt_deg: float
    grasp_kept: bool
    in_hand_mm: float
    trials: list[dict[str, Any]] = field(default_factory=list)


class Insertion:
    """Couples the lock-step cell, the service's session and the client's machine; `run` plays it to the end."""

    def __init__(
        self, world: LockstepCell, models: ModelSet, controller: ControllerName, override: Override | None = None
    ) -> None:
        self.world = world
        left, right = (_finger(models, world, index) for index in range(2))
        self.session = InsertionSession(models, left, right, controller_name=controller)
        x, y, z, yaw = world.pose
        plan = Plan(
            insertion_id="simulated",
            approach=WorkPose(x_mm=x, y_mm=y, z_mm=z, yaw_deg=yaw),
            gap_width_mm=world.scene.blocks.gap_mm,
            expected_depth_mm=25.0,
        )
        self.state = State(plan)
        self.override = override
        self.trials: list[dict[str, Any]] = []
        self._events: deque[Event] = deque()
        self._error: tuple[float, float] = world.state.object_error
        self._standing = False

    def run(self) -> Outcome:
        """Play the insertion to its end; raises PhysicsError where the cell finds no equilibrium."""
        world = self.world
        self._post(Begin(at_s=world.now_s, pose=self._pose()))
        for _ in range(MAX_FRAMES):
            if self.state.done:
                break
            self._frame()
        error = world.state.object_error
        blocks = world.state.block_motion
        return Outcome(
            inserted=self.state.phase is Phase.INSERTED,
            attempts=self.state.attempt,
            reason=self.state.reason,
            final_error=(float(error[0]), float(error[1])),
            block_motion_mm=float(np.hypot(blocks[:, 0], blocks[:, 1]).max()),
            block_tilt_deg=float(blocks[:, 3].max()),
            grasp_kept=not world.state.grasp_lost,
            in_hand_mm=world.worst_in_hand_mm,
            trials=self.trials,
        )

    def _frame(self) -> None:
        was_moving = self.world.moving
        pair = self.world.next_pair()
        now_ns = self.world.now_ns
        self._hear(self.session.on_pair(pair, now_ns))
        self._hear(self.session.on_tick(now_ns))
        self._post(ClientTick(at_s=self.world.now_s))
        if was_moving and not self.world.moving:
            self._standing = True
        if self._standing and not self.world.moving:
            self._standing = False
            event = Standstill if self.state.phase is Phase.STOPPING else Arrived
            self._post(event(at_s=self.world.now_s, pose=self._pose()))

    def _hear(self, messages: list[Any]) -> None:
        for message in messages:
            heard = message
            if isinstance(message, Correction | NoDecision):
                heard = self._note(message)
            self._post(FromService(at_s=self.world.now_s, message=heard))

    def _note(self, message: Correction | NoDecision) -> Correction | NoDecision:
        """Log the attempt beside the truth; a baseline puts its own move in the correction's place."""
        if isinstance(message, Correction) and self.override:
            dx, dtheta = self.override(message.attempt, self.world.state.object_error)
            message = message.model_copy(update={"dx_mm": dx, "dtheta_deg": dtheta})
        self.trials.append({"error_before": list(self._error), "decision": message.model_dump(mode="json")})
        return message

    def _post(self, event: Event) -> None:
        self._events.append(event)
        while self._events:
            self.state, commands = step(self.state, self._events.popleft())
            for command in commands:
                self._carry_out(command)

    def _carry_out(self, command: Command) -> None:
        match command:
            case Say():
                self._hear(self.session.handle(command.message, self.world.now_ns))
            case Grasp():
                self._events.append(Grasped(at_s=self.world.now_s, width_mm=80.0))
            case Hold():
                if self.world.moving:
                    self.world.hold()
                else:
                    self._standing = True
            case Move() if command.motion == "descend":
                self._error = self.world.state.object_error
                self.world.descend(command.target.z_mm)
            case Move():
                target = command.target
                duration_s = self.state.plan.ramps.duration_s(self._pose(), target, command.motion)
                self.world.travel(target.x_mm, target.y_mm, target.z_mm, target.yaw_deg, duration_s)
                self._events.append(Arrived(at_s=self.world.now_s, pose=self._pose()))

    def _pose(self) -> WorkPose:
        x, y, z, yaw = self.world.pose
        return WorkPose(x_mm=x, y_mm=y, z_mm=z, yaw_deg=yaw)


def _finger(models: ModelSet, world: LockstepCell, index: int) -> TactileFinger:
    calibration = CameraCalibration(world.renderers[index].homography)
    return TactileFinger(FINGERS[index], models.card.frame, calibration)


@dataclass(frozen=True, slots=True)
class Job:
    """One insertion to play: scene name, start error, seed, and who decides."""

    scene: str
    index: int
    x_mm: float
    theta_deg: float
    seed: int
    controller: ControllerName
    baseline: str

    @property
    def key(self) -> str:
        """What a resumed run recognises it by."""
        return f"{self.scene}/{self.controller}/{self.baseline}/{self.seed}/{self.index}"


def oracle_step(_: int, error: tuple[float, float]) -> tuple[float, float]:
    """The move that a controller would make which sees the true error; only sensing noise-free control is left."""
    return -error[0], -error[1]


BASELINES: dict[str, Override | None] = {"none": None, "oracle": oracle_step}


def insert(job: Job, models: ModelSet) -> Outcome:
    """One insertion with free blocks; a start that fits at once counts, as in the paper."""
    world = LockstepCell.build(load_scene(job.scene, blocks__free=True), job.x_mm, job.theta_deg, job.seed)
    return Insertion(world, models, job.controller, BASELINES[job.baseline]).run()
