"""An insertion's task (Plan) and its memory (State)."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

from pydantic import Field

from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.lease import PAUSE_S, ClockMap, Lease
from robot_client.insertion.limits import LimitError, Limits, Positive, check_pose
from robot_client.insertion.motion import Ramps, check_ramps
from robot_client.insertion.pace import ONE_SPEED, Pace, Tops
from service.contract import wire
from service.contract.frames import Contract, Finger
from service.contract.wire_parts import DEPTH_TOLERANCE_MM


class Phase(StrEnum):
    """Phase of an insertion."""

    START = "start"
    GREETING = "greeting"
    LEARNING = "learning"
    GRASPING = "grasping"
    APPROACHING = "approaching"
    ARMING = "arming"
    DESCENDING = "descending"
    STOPPING = "stopping"
    DECIDING = "deciding"
    RETRACTING = "retracting"
    CORRECTING = "correcting"
    CLOSING = "closing"
    INSERTED = "inserted"
    PROBED = "probed"
    FAILED = "failed"


TERMINAL = frozenset({Phase.INSERTED, Phase.PROBED, Phase.FAILED})
REFUSED = "service: refused: turned_in_hand:"
TURNED = (REFUSED, "service: afresh:")
LEANS_DEG = 0.5  # inaccuracy of an upright tool that limits.max_tilt_deg leaves room for
SLOWEST_MM_S = 4.0  # after an object has turned; more slowly, frames at 120 Hz are closer together than in training


class Timeouts(Contract):
    """Largest duration of each phase; ``motion_s`` is added to the planned time of a move.

    ``closing_s``: `finished` comes once the recording is on its disk, which may be a slow share; the arm stands.
    """

    greeting_s: Positive = 10.0
    grasping_s: Positive = 15.0
    arming_s: Positive = 3.0
    stopping_s: Positive = 1.5
    deciding_s: Positive = 4.0
    closing_s: Positive = 30.0
    motion_s: Positive = 3.0


class Plan(Contract):
    """One insertion to do. ``approach`` is the TCP's pose above the gap with the start error in it.

    ``over_mm``: height to which an object is lifted out of its fixture before it goes sideways; None: no higher than
    the approach.

    ``continues``: the insertion that this one continues, with the object regrasped. ``fixture``: whether there is one
    for regrasping an object that has turned in the hand. ``gels``: gels with which the cell was commissioned.
    ``signs_known``: whether a commissioning has shown which way each finger sees a turn; only then may the service ask
    to tilt the tool. ``tops_level_mm``: how level the tops on both sides of the gap are, see `wire.Arm`.
    ``neighbours_stay``: no press pushes aside what stands beside the gap.

    ``pause_s``: time within which a descent whose lease has ended may be resumed; 0 if the arm cannot stop and go on.

    A probe follows no correction. Whatever was decided, it goes up again and over to the next of its ``starts``, and
    ends after the last one. ``until_slip``: a probe that presses on until the gel slides, to identify the gel.

    ``no_decisions``: number of attempts in a row without a decision before the object was regrasped. ``met``: where the
    attempts before that met the tops.

    ``creep_allowance_mm``: extra depth of the TCP below ``expected_depth_mm`` where earlier attempts pushed the object
    up in the hand, so that its bottom gets to full depth. 0: none. ``clearance_mm``: the object's bottom above the
    blocks' tops at the approach, as far as known.
    """

    insertion_id: wire.InsertionId
    continues: wire.InsertionId | None = None
    fixture: bool = False
    approach: WorkPose
    over_mm: float | None = None
    clearance_mm: Positive = 5.0
    gap_width_mm: float = Field(gt=0, le=1000)  # these six have the bounds of the message `arm`
    grasp_height_mm: float | None = Field(default=None, gt=0, le=500)
    grip_n: float | None = Field(default=None, gt=0, le=1000)
    shear_reach_mm: float | None = Field(default=None, gt=0, le=100)
    tops_level_mm: float | None = Field(default=None, ge=0, le=10)
    neighbours_stay: bool = False
    expected_depth_mm: float = Field(gt=0, le=1000)
    depth_tolerance_mm: float = Field(default=DEPTH_TOLERANCE_MM, gt=0, le=DEPTH_TOLERANCE_MM)
    creep_allowance_mm: float = Field(default=0.0, ge=0, le=50)
    max_no_decisions: int = 2
    no_decisions: int = 0
    purpose: Literal["insert", "probe", "timing"] = "insert"
    starts: tuple[WorkPose, ...] = Field(default=(), max_length=wire.MAX_ATTEMPTS - 2)
    until_slip: bool = False
    client: str = "tactile-insertion robot client"
    object: str = Field(default="", max_length=128)
    controller: wire.ControllerName | None = None
    limits: Limits = Limits()
    ramps: Ramps = Ramps()
    timeouts: Timeouts = Timeouts()
    lease: Lease = Lease()
    gels: dict[Finger, str] = Field(default_factory=dict)
    signs_known: bool = False
    met: Tops | None = None
    pause_s: float = Field(default=0.0, ge=0.0, le=PAUSE_S)
    pace: Pace = ONE_SPEED

    def at_speed(self, speed_mm_s: float) -> "Plan":
        """This plan, with a slower guarded descent."""
        descend = self.ramps.descend.model_copy(update={"speed_mm_s": speed_mm_s})
        ramps = self.ramps.model_copy(update={"descend": descend})
        return self.model_copy(update={"ramps": ramps, "lease": self.lease.at_most(speed_mm_s)})

    def check(self) -> None:
        """Raise LimitError for a pose, a ramp, a speed or a lease that is not allowed, or a depth above the blocks."""
        least_mm = self.expected_depth_mm - self.depth_tolerance_mm
        if not least_mm > self.clearance_mm:
            above = f"the object is still above the blocks there (approach_clearance_mm = {self.clearance_mm:g})"
            raise LimitError(f"expected_depth_mm less its tolerance is {least_mm:g}: {above}")
        for target in (self.approach, *self.starts, self.deepest):
            check_pose(self.limits, target, "plan")
        check_ramps(self.limits, self.ramps)
        self.lease.check(self.ramps.descend.speed_mm_s)
        self.pace.check(self.limits)
        if self.pace.fast_mm_s is not None:
            self.fast_lease.check_travel(self.pace.fast_mm_s)

    @property
    def only_probes(self) -> bool:
        """Whether it follows no correction: for a probe, and for a press that times the cell."""
        return self.purpose != "insert"

    @property
    def most_tilt_deg(self) -> float:
        """How far the service may ask to tilt the tool; the arm, which leans by itself, keeps to its limit then."""
        if not self.signs_known:
            return 0.0
        return min(self.limits.max_straighten_deg, max(0.0, self.limits.max_tilt_deg - LEANS_DEG))

    @property
    def tops(self) -> Tops:
        """Where the TCP should be when the object touches the blocks' tops."""
        height_mm = self.approach.z_mm - self.clearance_mm
        return Tops(height_mm, height_mm)

    @property
    def lasts_s(self) -> float:
        """How old the newest judged frame may grow in a descent; both leases hold in one that has fast legs."""
        lasts_s = self.lease.lasts_s(self.ramps.descend.speed_mm_s)
        if self.pace.fast_mm_s is None:
            return lasts_s
        return min(lasts_s, self.fast_lease.lasts_s(self.pace.fast_mm_s))

    def check_cameras(self, cameras: Iterable[wire.CameraEntry]) -> None:
        """Raise LimitError for a camera too slow for the descent, or behind a gel that was not commissioned."""
        for camera in cameras:
            self.lease.check_rate(self.ramps.descend.speed_mm_s, camera)
            if self.gels and camera.gel != self.gels.get(camera.finger):
                raise LimitError(
                    f"the {camera.finger} gel is not the one that this cell was commissioned with: commission it again"
                )

    def with_legs_for(self, cameras: Iterable[wire.CameraEntry]) -> "Plan":
        """This plan, with fast legs no faster than the cameras' rate and the stop lag bear.

        Where that is no faster than probing it has none, as for an arm that cannot stop and go on.
        """
        if self.pace.fast_mm_s is None:
            return self
        rates_hz = [camera.frame_rate_hz for camera in cameras if camera.frame_rate_hz is not None]
        fast_mm_s = min([self.pace.fast_mm_s, *map(self.fast_lease.fastest_legs_mm_s, rates_hz)])
        lease = self.fast_lease.at_most(fast_mm_s)
        has_legs = self.pause_s and fast_mm_s > self.ramps.descend.speed_mm_s and lease.bears(fast_mm_s)
        legs = {"fast_mm_s": fast_mm_s if has_legs else None, "fast_travel_mm": lease.travel_mm}
        return self.model_copy(update={"pace": self.pace.model_copy(update=legs)})

    @property
    def fast_lease(self) -> Lease:
        """The lease of the fast legs."""
        return self.lease.model_copy(update={"travel_mm": self.pace.fast_travel_mm})

    @property
    def deepest(self) -> WorkPose:
        """The lowest pose below the approach at which a descent may ever end."""
        return self.approach.at_height(self.approach.z_mm - self.expected_depth_mm - self.creep_allowance_mm)


@dataclass(frozen=True, slots=True)
class State:
    """Everything the machine remembers. ``pose`` is the last commanded or measured pose of the arm.

    ``first_touch_mm`` is the depth at which the first blocked attempt stopped, ``creep_mm`` the additional depth of the
    last one: the object stood on the blocks at both, so it has been pushed up in the hand by about that much. ``held``:
    the gripper held something when the insertion began. ``width_mm``: distance of its fingers, as far as it reports it;
    ``open_mm``: before they closed.
    ``watched_s``: the earliest possible capture of the newest judged frame, on our clock. ``met``: heights at which
    attempts stopped on the tops. ``touched``: something has pressed on the object in this descent.
    ``speed_mm_s``: of the descent under way; ``speeds``: time (``at_s``), distance (mm) and value (mm/s) of its
    changes. ``straightened``: the last attempt before which the tool was tilted; ``arms_again``: it is being tilted,
    and the attempt keeps its number.
    """

    plan: Plan
    phase: Phase = Phase.START
    attempt: int = 0
    deadline_s: float = math.inf
    pose: WorkPose | None = None
    path: tuple[WorkPose, ...] = ()
    armed: WorkPose | None = None
    stopped_s: float = 0.0
    held: bool = False
    width_mm: float | None = None
    open_mm: float | None = None
    dropped: bool = False
    no_decisions: int = 0
    reason: str = ""
    first_touch_mm: float | None = None
    creep_mm: float = 0.0
    clock: ClockMap | None = None
    watched_s: float = -math.inf
    met: Tops | None = None
    touched: bool = False
    speeds: tuple[tuple[float, float, float], ...] = ()
    speed_mm_s: float = 0.0
    arms_again: bool = False
    straightened: int = 0

    @property
    def tops(self) -> Tops:
        """Where the object meets the blocks' tops, by the plan and by the attempts so far."""
        return self.met or self.plan.met or self.plan.tops

    @property
    def until_s(self) -> float:
        """The time at which the target of a descent must stop unless a newer frame is judged."""
        return self.watched_s + self.plan.lasts_s

    @property
    def done(self) -> bool:
        """True once no command follows."""
        return self.phase in TERMINAL

    @property
    def tried_n(self) -> int:
        """Attempts in which the arm descended; a refused one does not count."""
        return self.attempt - self.reason.startswith(REFUSED)

    def afresh(self, insertion_id: wire.InsertionId) -> Plan | None:
        """The plan after a regrasp from the fixture: from the object's last position, with the remaining attempts.

        It is slower than before around the blocks' tops, because the overtravel after contact is what turned the
        object. None if the insertion did not end because the object had turned in the hand, or no attempt is left.
        """
        tried_n, plan = self.tried_n, self.plan
        left_n = plan.limits.max_attempts - tried_n
        if not self.reason.startswith(TURNED) or self.armed is None or not tried_n or not left_n:
            return None
        probing_mm_s = plan.ramps.descend.speed_mm_s
        slower_mm_s = min(probing_mm_s, max(SLOWEST_MM_S, 0.5 * probing_mm_s))
        return plan.at_speed(slower_mm_s).model_copy(
            update={
                "insertion_id": insertion_id,
                "continues": plan.insertion_id,
                "no_decisions": self.no_decisions,
                "met": self.tops,
                "approach": self.armed.at_height(plan.approach.z_mm).tilted(0.0),
                "limits": plan.limits.model_copy(update={"max_attempts": left_n}),
            }
        )

    @property
    def bottom_mm(self) -> float:
        """Depth of the next descent below the armed pose, including the object's creep as far as allowed."""
        return self.plan.expected_depth_mm + min(self.creep_mm, self.plan.creep_allowance_mm)
