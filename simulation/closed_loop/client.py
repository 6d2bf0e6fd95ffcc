"""The client as played in lock step: its plan, and how its arm descends."""

from robot_client.insertion.events import Move
from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.lease import FAST_S, PAUSE_S, SLOW_MM, Lease
from robot_client.insertion.limits import Limits
from robot_client.insertion.motion import Ramps
from robot_client.insertion.state import Plan
from robot_client.session.travel import over_to
from robot_client.settings import Settings, load_settings
from simulation.closed_loop.job import Job
from simulation.closed_loop.lockstep import CREEP_ALLOWANCE_MM, LockstepCell, Walk
from simulation.scene.scene import TOPS_LEVEL_MM, Scene

ABOVE_MM = 30.0  # start of a played client's arm, above its usual approach
PROBING_MM_S = 10.0  # a quicker arm slows down to this, or it would push light blocks aside before it stands
SETTLE_S = 0.1  # from the end of a ramp, or of the stop lag, until the client takes the arm as at rest


FIXTURE_MM, RETREAT_MM = 300.0, 40.0
"""Path from the gap to the regrasp place, and the height above it from which on nothing is in the way."""
GRIPPER_S, GUIDANCE_S = 1.0, 1.0
"""Time to open or close the fingers of a cell, and to start the guidance of its arm: assumed, not measured."""


def longest_travel_mm(speed_mm_s: float) -> float:
    """The longest motion lease that may be requested at a speed, mm."""
    return max(SLOW_MM, FAST_S * speed_mm_s)


def staged(job: Job) -> tuple[Scene, Settings | None]:
    """The scene, at the speed at which the client probes; and the client's settings if the job has any.

    Without settings, the scene defines how the arm moves, no faster than the cameras' rate and a known lateness allow.
    Raises SettingsError.
    """
    scene, client = job.build_scene(), load_settings(None, dict(job.client)) if job.client else None
    if client:
        speed_mm_s = client.ramps.descend.speed_mm_s
    else:
        speed_mm_s = min(scene.speed_mm_s, PROBING_MM_S, Lease().late_by(job.late_s).fastest_mm_s(scene.fps))
    return scene.varied({"speed_mm_s": speed_mm_s}), client


def plan_of(
    cell: LockstepCell, approach: WorkPose, limits: Limits, reach_mm: float | None, client: Settings | None
) -> Plan:
    """The plan as the client knows the cell, which may be wrong."""
    scene, unstated, ramps = cell.scene, cell.unstated, Ramps()
    top_mm_s = max(limits.max_descent_speed_mm_s, scene.speed_mm_s)
    limits = limits.model_copy(update={"max_descent_speed_mm_s": top_mm_s})
    descend = ramps.descend.model_copy(update={"speed_mm_s": scene.speed_mm_s})
    room_mm = approach.z_mm - scene.full_depth_mm - limits.z_mm[0]  # a part held low leaves no room for its creep
    plan = Plan(
        insertion_id="simulated",
        approach=approach,
        gap_width_mm=scene.blocks.gap_mm + unstated.told_gap_error_mm,
        tops_level_mm=TOPS_LEVEL_MM,
        neighbours_stay=scene.neighbours_stay,
        grasp_height_mm=scene.grasp.height_mm + unstated.told_height_error_mm,
        grip_n=scene.grasp.force_n,
        shear_reach_mm=reach_mm,
        expected_depth_mm=scene.full_depth_mm,
        creep_allowance_mm=min(CREEP_ALLOWANCE_MM, max(0.0, room_mm)),
        limits=limits,
        ramps=ramps.model_copy(update={"descend": descend}),
        pause_s=PAUSE_S,
        fixture=True,
        lease=Lease(travel_mm=longest_travel_mm(scene.speed_mm_s)),
    )
    return plan if client is None else _as_set(plan, client)


def _as_set(plan: Plan, client: Settings) -> Plan:
    """The plan with the client's settings: its ramps, leases and pace, and its clearance at the approach."""
    lower_mm = plan.clearance_mm - client.task.approach_clearance_mm
    return plan.model_copy(
        update={
            "approach": plan.approach.at_height(plan.approach.z_mm - lower_mm),
            "clearance_mm": client.task.approach_clearance_mm,
            "expected_depth_mm": plan.expected_depth_mm - lower_mm,
            "limits": client.limits,
            "ramps": client.ramps,
            "lease": client.lease,
            "pace": client.pace,
        }
    )


def starts_of(plan: Plan, job: Job) -> tuple[WorkPose, ...]:
    """Further starts of a probe, above the gap."""
    return tuple(plan.approach.model_copy(update={"x_mm": x_mm, "yaw_deg": yaw_deg}) for x_mm, yaw_deg in job.starts)


def walk_of(plan: Plan, here: WorkPose, move: Move) -> Walk:
    if move.legs:
        return plan.ramps.in_legs(here.z_mm, move.legs).position
    return plan.ramps.profile(here, move.target, move.motion).position


def trip_s(plan: Plan) -> float:
    """Time to put an object back into its fixture and to return with it above the approach, s.

    The client's own way: up, over, down and open, then close, up and over, with a start of the guidance each. The
    fixture is as high as the approach.
    """
    gap = plan.approach
    fixture = gap.model_copy(update={"y_mm": gap.y_mm + FIXTURE_MM})
    clear_mm = fixture.z_mm + RETREAT_MM
    lines = [*over_to(fixture, clear_mm, "retract")(gap), *over_to(gap, clear_mm)(fixture)[:-1]]
    corners = [gap, *(corner for corner, _ in lines)]
    way_s = sum(plan.ramps.duration_s(here, *line) + SETTLE_S for here, line in zip(corners, lines, strict=False))
    return way_s + 2.0 * (GRIPPER_S + GUIDANCE_S)
