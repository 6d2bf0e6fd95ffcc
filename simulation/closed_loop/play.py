"""The closed loop faster than real time, with the service's own session and the robot client's own state machine.

`python -m simulation evaluate` runs the paper's test protocol in lock step: rendered frames go through the service's
perception, the shipped ONNX files and its controller; the answers go through the client's insertion machine. With
`client`, `oracle` and `session`, this is the only module of the simulator that imports them.
"""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import asdict
from functools import cache, partial
from pathlib import Path
from typing import Any

from robot_client.insertion.events import (
    Arrived,
    Begin,
    Command,
    Event,
    FromService,
    Grasp,
    Grasped,
    Hold,
    Move,
    Renew,
    Send,
    Standstill,
)
from robot_client.insertion.events import Tick as ClientTick
from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.limits import Limits
from robot_client.insertion.machine import step
from robot_client.insertion.seconds import AFRESH, Seconds
from robot_client.insertion.state import Phase, Plan, State
from robot_client.settings import Settings
from service.contract import FramePair
from service.contract.wire import Correction, LearnOpen, NoDecision
from service.decision.attempt import WorkResult
from service.decision.models import ModelSet, load_models
from service.decision.work import Work
from simulation.closed_loop.client import ABOVE_MM, SETTLE_S, plan_of, staged, starts_of, trip_s, walk_of
from simulation.closed_loop.job import Job, Outcome, Perception, Who
from simulation.closed_loop.lockstep import GraspEndError, LockstepCell
from simulation.closed_loop.oracle import by_the_truth, nothing_known
from simulation.closed_loop.session import measured, session_of
from simulation.closed_loop.true_fields import Fault, Trouble
from simulation.closed_loop.unseen import Unseen
from simulation.scene.state import PhysicsError, TouchingError
from simulation.scene.unstated import Unstated

MAX_FRAMES = 4000  # at 30 frames per second and 10 mm/s
FAR = Limits(max_dx_mm=45.0, max_dtheta_deg=45.0)  # the oracle's: no error is too large for it


class Insertion:
    """Couples the lock-step cell, the service's session and the client's machine; `run` plays it to the end."""

    def __init__(
        self,
        cell: LockstepCell,
        models: ModelSet,
        controller: Who,
        *,
        perception: Perception = "pictures",
        fault: Fault | None = None,
        reach_mm: float | None = None,
        client: Settings | None = None,
    ) -> None:
        self.cell = cell
        self.models = models
        self.oracle = controller == "oracle"
        self._troubles = {finger: Trouble(fault) for finger in fault.fingers} if fault else {}
        self._make_session = partial(session_of, models, cell, controller, perception, self._troubles)
        self.session = self._make_session()
        if self.oracle:  # the networks' answers are not used
            self.session.submit = self._skip_networks
        self.client = client
        self.grasps = 1
        self._tried = 0  # attempts with the object in its earlier grasps
        self.state = State(plan_of(cell, self._pose(), FAR if self.oracle else Limits(), reach_mm, client))
        self.seconds, self.unseen = Seconds(), Unseen()
        self.watches: Callable[[State, Event], None] = lambda _state, _event: None
        self.trials: list[dict[str, Any]] = []
        self.until: frozenset[Phase] = frozenset()  # phases that stop the play
        self.before = cell.state  # the unloaded state at the start of the descent
        self._events: deque[Event] = deque()
        self._standing, self._skipped_n = False, 0

    def begin_again(self, plan: Plan) -> None:
        """Let `run` play another insertion or probe, with the object as it is in the hand."""
        self.session, self.state, self._standing = self._make_session(), State(plan), False
        self.cell.speed_mm_s = plan.ramps.descend.speed_mm_s

    def run(self) -> Outcome:
        """Play the insertion to its end; if the physics fails, it is void and counts as failed."""
        cell, void = self.cell, ""
        try:
            self._play()
        except PhysicsError as stuck:
            void = f"physics: {stuck.reason}: {stuck}"
        except (GraspEndError, TouchingError) as ended:
            void = f"physics: {ended}"
        troubles, claimed = self._troubles.values(), self.state.phase is Phase.INSERTED
        in_gap = cell.state.inserted and not void and not any(trouble.gone for trouble in troubles)
        return Outcome(
            inserted=claimed and in_gap,
            claimed=claimed,
            attempts=self._tried + self.state.attempt,
            grasps=self.grasps,
            reason=void or self.state.reason,
            void=bool(void),
            final_error=(float(cell.state.object_error[0]), float(cell.state.object_error[1])),
            grasp_kept=not cell.state.grasp_lost,
            course=cell.course,
            trials=self.trials,
            in_gap=in_gap,
            seconds=self.seconds.spent,
            shortfalls=cell.state.shortfalls,
            fault_acted=any(trouble.struck for trouble in troubles),
            unseen_mm=self.unseen.most_mm,
            grasp_height_mm=self.state.plan.grasp_height_mm,
            unseen_allowed_mm=max(self.state.plan.lease.travel_mm, self.state.plan.fast_lease.travel_mm),
        )

    def _play(self) -> None:
        self._begin_above()
        self._post(Begin(at_s=self.cell.now_s, pose=self._pose()))
        scene = self.cell.scene
        longer = max(1.0, scene.fps / 30.0) * max(1.0, 10.0 / scene.speed_mm_s)
        for _ in range(round(longer * MAX_FRAMES)):
            if self.state.phase in self.until or (self.state.done and not self._takes_afresh()):
                break
            self._frame()

    def take_afresh(self, plan: Plan) -> None:
        """Regrasp the object from its fixture, at the pose with which the plan begins."""
        took_s = trip_s(plan)
        self.cell.take_afresh(plan.approach.x_mm, plan.approach.y_mm, plan.approach.yaw_deg, took_s)
        self.grasps, self.seconds.spent[AFRESH] = self.grasps + 1, self.seconds.spent[AFRESH] + took_s

    def _begin_above(self) -> None:
        """A client with settings of its own comes from above its approach."""
        if self.client:
            x, y, z, yaw = self.cell.pose
            self.cell.travel(x, y, z + ABOVE_MM, yaw, 1.0)

    def _takes_afresh(self) -> bool:
        """Whether the object is regrasped from its fixture and tried again, as in the client's cycle."""
        plan = self.state.afresh(f"simulated-{self.grasps + 1}") if self.state.plan.fixture else None
        if plan is None:
            return False
        self._tried += self.state.tried_n
        self.take_afresh(plan)
        self._begin_above()
        before = self.session
        self.begin_again(plan)
        self.session.submit, self.session.on_attempt = before.submit, before.on_attempt
        self.session.decider = before.decider and before.decider.afresh(plan.insertion_id)
        self._post(Begin(at_s=self.cell.now_s, pose=self._pose()))
        return True

    def _frame(self) -> None:
        was_moving, state = self.cell.moving, self.state
        self.cell.stands_s = math.inf
        if state.phase is Phase.DESCENDING:
            self.cell.stands_s = state.until_s + self.cell.unstated.stop_lag_s
        pair = self.cell.next_pair(look=self.session.wants_frames)
        self.unseen.frame(now_ns := self.cell.now_ns, self.cell.exposed_mm, self.cell.pose[2])
        self._show(pair, now_ns)
        self._hear(self.session.on_tick(now_ns))
        self._post(ClientTick(at_s=self.cell.now_s))
        self._standing |= was_moving and not self.cell.moving
        if self._standing and not self.cell.moving and self.cell.still_s >= (SETTLE_S if self.client else 0.0):
            self._standing, now_s, pose = False, self.cell.now_s, self._pose()
            still = Standstill(at_s=now_s, pose=pose, still_s=self.cell.still_s)
            self._post(still if self.state.phase is Phase.STOPPING else Arrived(at_s=now_s, pose=pose))

    def _show(self, pair: FramePair, now_ns: int) -> None:
        arrived = self.cell.arrived()
        if all(arrived):
            self._hear(self.session.on_pair(pair, now_ns))
        else:
            for frame, came in zip((pair.left, pair.right), arrived, strict=True):
                if came:
                    self._hear(self.session.on_frame(frame, now_ns))
        while self._skipped_n:
            self._skipped_n, attempt = self._skipped_n - 1, self.session.attempt
            if attempt is not None and attempt.result is None:
                named = attempt.arm.insertion_id, attempt.generation
                result = WorkResult(*named, nothing_known(self.models), None, {}, attempt.run)
                self._hear(self.session.on_result(result, now_ns))

    def _skip_networks(self, _: Work) -> None:
        """Stand in for unused networks: done with the last frame of the decision."""
        attempt = self.session.attempt
        if attempt is not None and attempt.fed:
            self._skipped_n += 1

    def _hear(self, messages: list[Any]) -> None:
        for message in messages:
            self.unseen.heard(message)
            noted = self._note(message) if isinstance(message, Correction | NoDecision) else message
            self._post(FromService(at_s=self.cell.now_s, message=noted))

    def _note(self, message: Correction | NoDecision) -> Correction | NoDecision:
        """Log the attempt with the ground truth; with the oracle, replace the correction by its own move."""
        if self.oracle:
            if self.session.decider:
                self.session.decider.consistency = None  # the arm follows the oracle's moves
            message = by_the_truth(message, self.before.object_error)
        decision = message.model_dump(mode="json", exclude={"insertion_id", "latency_ms"})
        wrench = [round(float(v), 3) for v in self.cell.state.wrench_n_nmm]
        trial = {"error_before": list(self.before.object_error), "wrench": wrench, "decision": decision}
        self.trials.append(trial | measured(self.session.attempt, self.state.plan.clearance_mm))
        return message

    def _post(self, event: Event) -> None:
        self._events.append(event)
        while self._events:
            event = self._events.popleft()
            self.state, commands = step(self.state, event)
            self.seconds.on_event(self.state, event)
            self.watches(self.state, event)
            for command in commands:
                self._carry_out(command)

    def _carry_out(self, command: Command) -> None:
        match command:
            case Send():
                self._hear(self.session.handle(command.message, self.cell.now_ns))
                if isinstance(command.message, LearnOpen):
                    self._hear(self.session.on_pair(self.cell.open_pair(), self.cell.now_ns))
            case Grasp():
                self._events.append(Grasped(at_s=self.cell.now_s, width_mm=self.cell.scene.object.held_width_mm))
            case Hold():
                if self.cell.moving:
                    self.cell.hold()
                else:
                    self._standing = True
            case Renew():
                pass  # every frame asks the machine whether the lease still holds
            case Move() if command.motion == "descend":
                self.before = self.cell.state
                self.cell.descend(
                    command.target.z_mm, walk_of(self.state.plan, self._pose(), command) if self.client else None
                )
            case Move():
                target = command.target
                duration_s = self.state.plan.ramps.duration_s(self._pose(), target, command.motion)
                duration_s += SETTLE_S if self.client else 0.0
                to = target.x_mm, target.y_mm, target.z_mm, target.yaw_deg
                self.cell.travel(*to, duration_s, tilt_deg=target.tilt_deg)
                self._events.append(Arrived(at_s=self.cell.now_s, pose=self._pose()))

    def _pose(self) -> WorkPose:
        x, y, z, yaw = self.cell.pose
        return WorkPose(x_mm=x, y_mm=y, z_mm=z, yaw_deg=yaw, tilt_deg=self.cell.tilt_deg)


def stage(job: Job, models: ModelSet) -> Insertion:
    """The insertion of a job, ready to run: blocks free, the object in the hand."""
    scene, client = staged(job)
    perception: Perception = "fields" if job.controller == "oracle" else job.perception
    build = partial(LockstepCell.build, make=job.mechanics(), cameras=job.cameras())
    unstated, draws = Unstated.model_validate(job.unstated), perception == "pictures"
    cell = build(scene, job.x_mm, job.theta_deg, job.seed, unstated=unstated, draws=draws)
    insertion = Insertion(
        cell,
        models,
        job.controller,
        perception=perception,
        fault=Fault(**job.fault) if job.fault else None,
        reach_mm=job.measured_reach_mm(scene),
        client=client,
    )
    plan = insertion.state.plan
    known = {"purpose": job.purpose, "lease": plan.lease.late_by(job.late_s), "signs_known": job.commissioned}
    probes = {"fixture": False, "starts": starts_of(plan, job)} if job.purpose == "probe" else {}
    insertion.state = State(plan.model_copy(update=known | probes))
    return insertion


def insert(job: Job, models: ModelSet) -> dict[str, Any]:
    """Play a job and return its row of results. A start that fits at once counts, as in the paper.

    An object that cannot be grasped as in the scene is void.
    """
    try:
        outcome = stage(job, models).run()
    except PhysicsError as error:
        outcome = Outcome.never_began(job, f"physics: {error.reason}: {error}", void=True)
    return asdict(job) | asdict(outcome)


@cache
def models_of(folder: Path) -> ModelSet:
    """The networks of a folder, loaded once per process."""
    return load_models(folder)
