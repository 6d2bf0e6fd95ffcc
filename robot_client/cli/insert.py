"""What the command line does, one function a command; each returns the exit code."""

import asyncio
import os
import secrets
import signal
import socket
import sys
import time
from pathlib import Path
from urllib.parse import urlsplit

from robot_client.grippers.wsg50.driver import Wsg50
from robot_client.grippers.wsg50.text_driver import GclGripper
from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.state import Phase, Plan
from robot_client.ports import Arm, DecisionService, Gripper
from robot_client.robots.abb_egm.driver import EgmArm
from robot_client.robots.abb_rapid.driver import SocketArm
from robot_client.robots.abb_rws.client import RwsClient
from robot_client.robots.dry_run.driver import DryArm, DryGripper, DryService
from robot_client.session.recorder import Recorder
from robot_client.session.report import Report
from robot_client.session.runner import Runner
from robot_client.session.service_link import ServiceLink
from robot_client.settings import Settings
from service.contract.wire import ControllerName

NOT_A_SAFETY_FUNCTION = "LIVE: this moves a real robot. It is not a safety function; the cell's guards and stops are."


def make_plan(
    settings: Settings, x_mm: float, theta_deg: float, insertion_id: str | None, controller: ControllerName | None
) -> Plan:
    """The plan of one insertion with the start error (x_mm, theta_deg) in its approach pose."""
    task = settings.task
    approach = WorkPose(x_mm=x_mm, y_mm=task.approach_y_mm, z_mm=task.approach_z_mm, yaw_deg=theta_deg)
    return Plan(
        insertion_id=insertion_id or f"{time.strftime('%Y%m%d-%H%M%S')}-{secrets.token_hex(3)}",
        approach=approach,
        gap_width_mm=task.gap_width_mm,
        grasp_height_mm=task.grasp_height_mm,
        expected_depth_mm=task.expected_depth_mm,
        depth_tolerance_mm=task.depth_tolerance_mm,
        creep_allowance_mm=task.creep_allowance_mm,
        max_no_decisions=task.max_no_decisions,
        controller=controller,
        limits=settings.limits,
        ramps=settings.ramps,
        timeouts=settings.timeouts,
    )


def live_arm(settings: Settings) -> Arm:
    """The arm over EGM or RAPID sockets, and RWS; guidance is only given to the host that RWS names."""
    frame = settings.work_object.frame()
    if settings.robot.link == "socket":  # its RAPID task restarts itself after a lost connection
        rws = RwsClient(settings.rws.model_copy(update={"cycle": "forever"}))
        return SocketArm(settings.socket, settings.limits, settings.ramps, frame, rws)
    rws = RwsClient(settings.rws)
    egm = settings.egm
    if egm.robot_host is None:
        egm = egm.model_copy(update={"robot_host": _address_of(settings.rws.url)})
    return EgmArm(egm, settings.limits, settings.ramps, frame, rws)


def _address_of(url: str) -> str | None:
    """The address behind a URL's host, as datagrams carry it; None where nobody knows it: then RWS finds no robot."""
    try:
        return socket.gethostbyname(urlsplit(url).hostname or "")
    except OSError:
        return None


def live_ports(settings: Settings, plan: Plan) -> tuple[Arm, Gripper, DecisionService]:
    """Drivers of the real protocols."""
    gripper: Gripper = Wsg50(settings.gripper)
    if settings.gripper.protocol == "text":
        gripper = GclGripper(settings.gripper)
    return live_arm(settings), gripper, ServiceLink(settings.service, plan.insertion_id)


def dry_ports(settings: Settings, plan: Plan) -> tuple[Arm, Gripper, DecisionService]:
    """The rehearsal: starts 40 mm above the approach pose, knows the start error."""
    service = DryService(plan.insertion_id, settings.limits, plan.approach.z_mm)
    start = plan.approach.at_height(plan.approach.z_mm + 40.0)
    arm = DryArm(settings.limits, settings.ramps, start, on_target=service.watch)
    return arm, DryGripper(), service


def insert(settings: Settings, plan: Plan, *, live: bool, log: Path | None) -> int:
    """Run one insertion; 0 inserted, 1 not inserted or failed safe. Raises DriverError if a device is not ready."""
    show(NOT_A_SAFETY_FUNCTION if live else "DRY RUN: nothing is connected, nothing moves (type --live to move).")
    show(f"insertion {plan.insertion_id}: start x {plan.approach.x_mm:+.2f} mm, yaw {plan.approach.yaw_deg:+.2f} deg")
    return asyncio.run(_insert(settings, plan, live=live, log=log))


async def _insert(settings: Settings, plan: Plan, *, live: bool, log: Path | None) -> int:
    arm, gripper, service = (live_ports if live else dry_ports)(settings, plan)
    report = Report(arm.position, show)
    runner = Runner(plan, arm, gripper, service, Recorder(log, plan), (report,))
    stop_on_signals()
    state = await runner.run()
    for line in report.final(state, runner.farewell, arm.statistics()):
        show(line)
    if log is not None:
        lost = f", BROKEN OFF: {runner.recorder.lost}" if runner.recorder.lost else ""
        show(f"  log         {log}{lost}")
    return 0 if state.phase is Phase.INSERTED else 1


def show(text: str) -> None:
    """Print a line; once the terminal is gone nothing is said any more, and nothing else changes."""
    try:
        print(text, flush=True)
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what is left in its buffer goes there


def stop_on_signals() -> None:
    """Ctrl-C, SIGTERM and a terminal that hangs up (but for `nohup`) hold the arm and end the insertion in order."""
    task = asyncio.current_task()
    assert task is not None
    loop = asyncio.get_running_loop()
    hang_up = () if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN else (signal.SIGHUP,)
    for number in (signal.SIGINT, signal.SIGTERM, *hang_up):
        loop.add_signal_handler(number, task.cancel)
