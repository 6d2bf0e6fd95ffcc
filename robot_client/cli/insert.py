"""`insert`: one insertion, a rehearsal without --live."""

import asyncio
from collections.abc import Callable
from functools import partial
from pathlib import Path

from robot_client.cli.terminal import Outcome, show, stop_on_signals, warning
from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.lease import PAUSE_S
from robot_client.insertion.state import Phase, Plan, State
from robot_client.ports import Arm, DecisionService, Gripper
from robot_client.session.afresh import Fixture, new_id, upright
from robot_client.session.commission.record import commissioned
from robot_client.session.recorder import Recorder
from robot_client.session.rehearsal import rehearsal_ports
from robot_client.session.report import Report
from robot_client.session.runner import Runner
from robot_client.session.service_link import ServiceLink
from robot_client.settings import Settings, SettingsError
from service.contract.wire import ControllerName


def make_plan(
    settings: Settings, x_mm: float, theta_deg: float, insertion_id: str | None, controller: ControllerName | None
) -> Plan:
    """The plan of one insertion with the start error (x_mm, theta_deg) in its approach pose."""
    task = settings.task
    approach = WorkPose(x_mm=x_mm, y_mm=task.approach_y_mm, z_mm=task.approach_z_mm, yaw_deg=theta_deg)
    return Plan(
        insertion_id=insertion_id or new_id(),
        approach=approach,
        over_mm=None if settings.cycle is None else settings.cycle.above(settings.cycle.pick).z_mm,
        clearance_mm=task.approach_clearance_mm,
        grasp_height_mm=task.grasp_height_mm,
        **task.model_dump(exclude={"approach_y_mm", "approach_z_mm", "approach_clearance_mm"}),
        controller=controller,
        limits=settings.limits,
        ramps=settings.ramps,
        timeouts=settings.timeouts,
        lease=settings.lease,
        pause_s=PAUSE_S if settings.robot.pauses else 0.0,
        pace=settings.pace,
    )


def with_commissioning(settings: Settings, plan: Plan, *, asked: bool) -> Plan:
    """The plan with the gels and the lateness of the cell's commissioning; SettingsError for an uncommissioned cell.

    So is one whose lateness is neither measured nor set. A simulated cell needs none: its signs are right. ``asked`` is
    False with --uncommissioned.
    """
    if settings.simulated or not asked:
        return plan.model_copy(update={"signs_known": settings.simulated})
    if settings.commissioning is None:
        raise SettingsError(
            'the configuration names no record of a commissioning (commissioning = "FILE"): run'
            " `commission --live --config FILE` first, or type --uncommissioned"
        )
    record = commissioned(settings.commissioning)
    if record.late_s is None and "stop_lag_s" not in settings.lease.model_fields_set:
        raise SettingsError(
            f"{settings.commissioning} does not show how late pictures and arm are, and lease.stop_lag_s is not set:"
            " run `commission --live --config FILE` again with a wider part or a firmer grip, or set it"
        )
    known = {"gels": record.gels, "signs_known": True, "lease": plan.lease.late_by(record.late_s)}
    return plan.model_copy(update=known)


def live_ports(settings: Settings, plan: Plan) -> tuple[Arm, Gripper, DecisionService]:
    """The configured devices and the service; the arm moves at the plan's speed, for which its lease is made."""
    arm = settings.model_copy(update={"ramps": plan.ramps}).make_arm()
    return arm, settings.make_gripper(), ServiceLink(settings.service, plan.insertion_id)


def insert(settings: Settings, plan: Plan, *, live: bool, log: Path | None) -> Outcome:
    """Run one insertion; done if inserted. Raises DriverError if a device is not ready."""
    if settings.cycle:
        settings.cycle.check(settings.limits)
    show(warning(live=live, simulated=settings.simulated))
    show(f"insertion {plan.insertion_id}: start x {plan.approach.x_mm:+.2f} mm, yaw {plan.approach.yaw_deg:+.2f} deg")
    show(f"closes the fingers, then goes {way_of(plan)}")
    return asyncio.run(_insert(settings, plan, live=live, log=log))


def fixture_of(settings: Settings) -> Fixture | None:
    """The fixture for regrasping an object that has turned in the hand; None if it was not taught."""
    taught = settings.cycle
    if taught is None:
        return None
    return Fixture(taught.pick, taught.open_mm, taught.retreat_mm, settings.errands)


def regrasp_of(settings: Settings) -> Fixture | None:
    """The fixture if an object that has turned is put back into it; None if it fills up again meanwhile."""
    return fixture_of(settings) if settings.cycle is not None and settings.cycle.regrasp else None


def way_of(plan: Plan) -> str:
    """The way of an insertion in words: from wherever the arm stands to full depth, with its speeds."""
    above, ramps = plan.approach.z_mm, plan.ramps
    down_mm_s = max(ramps.descend.speed_mm_s, plan.pace.fast_mm_s or 0.0)
    return (
        f"up to z {max(above, plan.over_mm or above):+g} mm at least, over, to z {above:+g} mm, at up to"
        f" {ramps.unwatched_mm_s:g} mm/s and with no watch for touch; then, watched, down to"
        f" z {plan.deepest.z_mm:+g} mm at up to {down_mm_s:g} mm/s"
    )


async def _insert(settings: Settings, plan: Plan, *, live: bool, log: Path | None) -> Outcome:
    ran: list[tuple[Runner, Callable[[State], list[str]]]] = []

    async def run(plan: Plan) -> State:
        written = log
        if ran:  # the object was regrasped
            written = log and log.with_stem(plan.insertion_id)
            show(f"insertion {plan.insertion_id}")
        arm, gripper, service = live_ports(settings, plan) if live else rehearsal_ports(plan)
        report = Report(arm.position, show)
        runner = Runner(plan, arm, gripper, service, Recorder(written, plan), (report,), settings.simulated)
        try:
            state = await runner.run()
        finally:
            _show_log(runner.recorder)
            final = partial(report.final, farewell=runner.farewell, link=runner.link(), rest=runner.rest())
            ran.append((runner, final))
        if plan.fixture and state.afresh(plan.insertion_id):  # the arm goes to the fixture, and the fingers open
            runner.check_stopped()
        return state

    def show_end(state: State) -> None:
        for line in ran[-1][1](state):
            show(line)

    stop_on_signals()
    try:
        state = await upright(plan, run, regrasp_of(settings) if live else None, show)
    except BaseException:
        if ran:  # in a grasp, or on the way to the next one
            show_end(ran[-1][0].state)
        raise
    show_end(state)  # with the attempts of all grasps
    runner, _ = ran[-1]
    runner.check_stopped()
    kept = runner.recorder
    summary = runner.summary() | {"attempts": state.attempt, "grasps": len(ran)}
    named = {"insertion_id": runner.plan.insertion_id, "log": kept.path and str(kept.path), "lost": kept.lost}
    return Outcome(state.phase is Phase.INSERTED, {**named, "live": live, **summary})


def _show_log(recorder: Recorder) -> None:
    if recorder.path is not None:
        lost = f", BROKEN OFF: {recorder.lost}" if recorder.lost else ""
        show(f"  log         {recorder.path}{lost}")
