"""The WSG-50-110 as a mechanism: fingers with ramps, a part that blocks them, the grasping state machine, faults.

Widths in mm, speeds in mm/s, forces in N. The spindle drive is self-locking: a held part stays held through power loss
and program stops; only opening the fingers releases it. Cited by section: [M] WSG Command Set Reference Manual,
firmware 4.0.0.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from robot_client.grippers.wsg50.codes import Command, GraspingState, Status, SystemState
from simulation.cell.emulators.faults import FaultBoard, take

STROKE_MM = 110.0
SPEED_MM_S = (5.0, 420.0)
ACCELERATION_MM_S2 = (100.0, 5000.0)
FORCE_N = (5.0, 80.0)
CLAMPING_TRAVEL_MM = 5.0
CLAMP_N = FORCE_N[1] / 2  # [M] 3.2.2: a move that clamps does so with half of the nominal force
_FORCE_RISE_S = 0.04
_GIVE_MM = 0.3  # opening this far beyond the part's width lets the part go: until then the pads still hold it

Finish = Callable[[Status], None]


class Part(Protocol):
    """What may stand between the fingers."""

    def width_mm(self) -> float | None:
        """Width at which the fingers meet it, None if nothing is there."""

    def gripped(self, force_n: float) -> None:
        """The fingers hold it with this force."""

    def released(self) -> None:
        """The fingers opened."""

    def lost(self) -> bool:
        """True once it has slipped out of the fingers."""


@dataclass(slots=True)
class _Motion:
    command: Command
    target_mm: float
    speed_mm_s: float
    finish: Finish
    clamps: bool = True


class Gripper:
    """Mechanism and state machine; ``advance`` moves its clock."""

    def __init__(self, part: Part, board: FaultBoard, *, holding: bool = True) -> None:
        self._part = part
        self._board = board
        self.referenced = True
        self.fast_stopped = False
        self.stopped = False
        self.reached = False
        self.blocked = False
        width = part.width_mm()
        self.holding = holding and width is not None
        self.width_mm = width if self.holding and width is not None else STROKE_MM - 1.0
        self.state = GraspingState.HOLDING if self.holding else GraspingState.IDLE
        self.speed_mm_s = 0.0
        self.acceleration_mm_s2 = 1000.0
        self.force_limit_n = 40.0
        self.force_n = self.force_limit_n if self.holding else 0.0
        self.soft_limits_mm: tuple[float, float] | None = None
        self._motion: _Motion | None = None
        self._clamping_to_mm: float | None = None
        self._squeeze_s: float | None = None

    @property
    def homed(self) -> bool:
        return self.referenced and not self._board.faults.gripper.not_homed

    # ---- commands: the immediate status; after PENDING, ``finish`` gets the final one -------------------------

    def home(self, direction: int, finish: Finish) -> Status:
        """Drive to an end stop and take it as reference."""
        if direction not in (0, 1, 2):
            return Status.INVALID_PARAMETER
        denied = self._denied()
        if denied is not Status.SUCCESS:
            return denied
        self.state = GraspingState.POSITIONING
        target = 0.0 if direction == 2 else STROKE_MM
        return self._go(_Motion(Command.HOMING, target, 50.0, finish))

    def move(
        self, command: Command, width_mm: float, speed_mm_s: float, finish: Finish, *, clamps: bool = True
    ) -> Status:
        """MOVE, GRASP or RELEASE towards a width; ``clamps``: a MOVE that meets a part keeps pressing it.

        [M] 3.2.2: width and speed beyond the physical limits are clamped to them; beyond the soft limits they are
        refused.
        """
        denied = self._denied()
        if denied is Status.SUCCESS and not self.homed:
            denied = Status.NOT_INITIALIZED
        if denied is Status.SUCCESS and not self._allowed(width_mm):
            denied = Status.RANGE_ERROR
        if denied is not Status.SUCCESS:
            return denied
        width_mm = min(max(width_mm, 0.0), STROKE_MM)
        speed_mm_s = min(max(speed_mm_s, SPEED_MM_S[0]), SPEED_MM_S[1])
        states = {Command.GRASP: GraspingState.GRASPING, Command.RELEASE: GraspingState.RELEASING}
        self.state = states.get(command, GraspingState.POSITIONING)
        target = max(0.0, width_mm - CLAMPING_TRAVEL_MM) if command is Command.GRASP else width_mm
        return self._go(_Motion(command, target, speed_mm_s, finish, clamps))

    def limit(self, minus_mm: float, plus_mm: float) -> Status:
        """Set the soft limits ([M] 3.3.5), if they are within the stroke and in order."""
        if not 0.0 <= minus_mm < plus_mm <= STROKE_MM:
            return Status.RANGE_ERROR
        self.soft_limits_mm = (minus_mm, plus_mm)
        return Status.SUCCESS

    def stop(self) -> Status:
        """End a motion (its command is aborted) and the part's monitoring; a held part stays held."""
        self._abort()
        self.stopped, self.blocked = True, False
        if self.state is not GraspingState.ERROR:
            self.state = GraspingState.IDLE
        return Status.SUCCESS

    def fast_stop(self, why: Status = Status.CMD_ABORTED) -> Status:
        """Stop and latch: nothing moves until the operator acknowledges; the motion's command ends with ``why``."""
        self._abort(why)
        self.fast_stopped = True
        self.state = GraspingState.ERROR
        return Status.SUCCESS

    def acknowledge(self) -> Status:
        if self.fast_stopped or self.state is GraspingState.ERROR:
            self.fast_stopped = False
            self.state = GraspingState.HOLDING if self.holding else GraspingState.IDLE
        return Status.SUCCESS

    def system_state(self) -> SystemState:
        """The bits of query 0x40 ([M] appendix B); true force control needs a finger that measures force."""
        faults = self._board.faults.gripper
        moving = self._motion is not None
        bits = {
            SystemState.REFERENCED: self.homed,
            SystemState.MOVING: moving,
            SystemState.BLOCKED_MINUS: self.blocked or self.holding,
            SystemState.AXIS_STOPPED: self.stopped,
            SystemState.TARGET_POS_REACHED: self.reached,
            SystemState.SOFT_LIMIT_MINUS: self.width_mm <= (self.soft_limits_mm or (-1.0, 0.0))[0],
            SystemState.SOFT_LIMIT_PLUS: self.width_mm >= (self.soft_limits_mm or (0.0, 2 * STROKE_MM))[1],
            SystemState.FAST_STOP: self.fast_stopped,
            SystemState.TEMP_WARNING: faults.temperature_warning,
        }
        value = SystemState(0)
        for bit, on in bits.items():
            if on:
                value |= bit
        return value

    # ---- time -------------------------------------------------------------------------------------------------

    def advance(self, elapsed_s: float) -> None:
        """Move the fingers and watch the part for ``elapsed_s``."""
        faults = self._board.faults.gripper
        if take(faults, "fast_stop"):
            self.fast_stop()
        if self.holding and (faults.part_lost or self._part.lost()):
            self._lose_part()
        if self._clamping_to_mm is not None and self._part.width_mm() is None:
            self._snap(self._clamping_to_mm)
        if self._squeeze_s is not None:
            self._squeeze(elapsed_s)
        elif self._motion is not None:
            self._travel(self._motion, elapsed_s)

    def _denied(self) -> Status:
        if self.fast_stopped:
            return Status.ACCESS_DENIED
        return Status.ALREADY_RUNNING if self._motion is not None else Status.SUCCESS

    def _allowed(self, width_mm: float) -> bool:
        """True if the soft limits allow this finger width."""
        low, high = self.soft_limits_mm or (-math.inf, math.inf)
        return low <= width_mm <= high

    def _snap(self, width_mm: float) -> None:
        """[M] 3.2.2: the clamped part is gone, and the fingers snap to the commanded width."""
        self.width_mm, self.force_n, self.blocked, self._clamping_to_mm = width_mm, 0.0, False, None

    def _go(self, motion: _Motion) -> Status:
        self.stopped = self.reached = self.blocked = False
        self._clamping_to_mm = None
        self.force_n = self.force_n if self.holding else 0.0
        self._motion = motion
        return Status.CMD_PENDING

    def _end(self, status: Status, state: GraspingState) -> None:
        motion, self._motion = self._motion, None
        self._squeeze_s = None
        self.speed_mm_s = 0.0
        self.state = state
        if motion is not None:
            motion.finish(status)

    def _abort(self, why: Status = Status.CMD_ABORTED) -> None:
        if self._motion is not None:
            self._end(why, GraspingState.IDLE)

    def _lose_part(self) -> None:
        self.holding, self.force_n = False, 0.0
        self._part.released()
        if self.state is GraspingState.HOLDING:
            self.state = GraspingState.PART_LOST
            self.width_mm = max(0.0, self.width_mm - CLAMPING_TRAVEL_MM)

    def _travel(self, motion: _Motion, elapsed_s: float) -> None:
        gap_mm = motion.target_mm - self.width_mm
        braking = (2.0 * self.acceleration_mm_s2 * abs(gap_mm)) ** 0.5
        wanted = min(motion.speed_mm_s, braking, abs(self.speed_mm_s) + self.acceleration_mm_s2 * elapsed_s)
        step_mm = min(abs(gap_mm), wanted * elapsed_s)
        self.speed_mm_s = wanted if gap_mm > 0 else -wanted
        width = self.width_mm + (step_mm if gap_mm > 0 else -step_mm)
        part_mm = self._part.width_mm()
        if gap_mm < 0 and part_mm is not None and width <= part_mm <= self.width_mm + 1e-9:
            self.width_mm = part_mm
            self._meet_part(motion)
            return
        if motion.command is not Command.HOMING and self._allowed(self.width_mm) and not self._allowed(width):
            self.fast_stop(Status.RANGE_ERROR)  # [M] 3.3.5: moving into the restricted area
            return
        self.width_mm = width
        if self.holding and part_mm is not None and width > part_mm + _GIVE_MM:
            self.holding, self.force_n = False, 0.0
            self._part.released()
        if abs(motion.target_mm - self.width_mm) < 1e-6:
            self._arrive(motion)

    def _meet_part(self, motion: _Motion) -> None:
        self.blocked = True
        if motion.command is Command.GRASP:
            self._squeeze_s = 0.0
        else:  # the vendor's flag: clamp on block is the default, stop on block removes the force
            self.force_n = CLAMP_N if motion.clamps else 0.0
            self._clamping_to_mm = motion.target_mm if motion.clamps else None
            self._end(Status.AXIS_BLOCKED, GraspingState.IDLE)

    def _squeeze(self, elapsed_s: float) -> None:
        self._squeeze_s = (self._squeeze_s or 0.0) + elapsed_s
        self.force_n = self.force_limit_n * min(1.0, self._squeeze_s / _FORCE_RISE_S)
        if self._squeeze_s >= _FORCE_RISE_S:
            self.holding = True
            self._part.gripped(self.force_n)
            self._end(Status.SUCCESS, GraspingState.HOLDING)

    def _arrive(self, motion: _Motion) -> None:
        if motion.command is Command.GRASP:
            self._end(Status.CMD_FAILED, GraspingState.NO_PART)
            return
        if motion.command is Command.HOMING:
            self.referenced = True
        self.reached = True
        self._end(Status.SUCCESS, GraspingState.IDLE)
