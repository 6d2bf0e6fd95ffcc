"""`check`: reads every device that an insertion needs and moves nothing; a line for each finding, bad ones say why."""

import asyncio
import contextlib
import socket
from collections.abc import Awaitable, Callable

from robot_client.grippers.wsg50 import codec
from robot_client.grippers.wsg50.codec import GraspingState, SystemState
from robot_client.grippers.wsg50.driver import Wsg50
from robot_client.grippers.wsg50.text_driver import GclGripper
from robot_client.insertion.events import Event, Failure, FromService
from robot_client.insertion.limits import check_pose
from robot_client.insertion.motion import check_ramps
from robot_client.ports import DriverError
from robot_client.robots.abb_rws.client import RwsClient
from robot_client.session.service_link import ServiceLink
from robot_client.settings import Settings
from service.contract import wire

Finding = tuple[bool, str]


def check(settings: Settings) -> int:
    """Print the findings; 0 if everything is ready for an insertion, 1 otherwise."""
    return asyncio.run(_check(settings))


async def _check(settings: Settings) -> int:
    looks: dict[str, Callable[[Settings], Awaitable[list[Finding]]]] = {
        "plan": _plan,
        "robot": _robot,
        "guidance": _guidance,
        "gripper": _gripper,
        "service": _service,
    }
    ready = True
    for name, look in looks.items():
        try:
            findings = await look(settings)
        except (ValueError, TimeoutError) as error:
            findings = [(False, str(error) or "no answer in time")]
        for good, text in findings:
            ready = ready and good
            print(f"{'ok  ' if good else 'BAD '} {name:9s} {text}", flush=True)
    print("ready to insert" if ready else "NOT ready")
    return 0 if ready else 1


async def _plan(settings: Settings) -> list[Finding]:
    from robot_client.cli.insert import make_plan

    plan = make_plan(settings, 0.0, 0.0, "check", None)
    bottom = plan.deepest
    check_pose(settings.limits, plan.approach, "approach")
    check_pose(settings.limits, bottom, "full insertion")
    check_ramps(settings.limits, settings.ramps)
    settings.work_object.frame()
    seconds = settings.ramps.duration_s(plan.approach, bottom, "descend")
    return [(True, f"approach z {plan.approach.z_mm:g} mm, full depth z {bottom.z_mm:g} mm, {seconds:.1f} s down")]


async def _robot(settings: Settings) -> list[Finding]:
    client = RwsClient(settings.rws)
    try:
        status = await client.status()
    finally:
        await client.close()
    motors = status.controller == "motoron" or (status.controller == "motoroff" and settings.rws.switch_motors_on)
    return [
        (status.operating_mode == "AUTO", f"operating mode {status.operating_mode} (expected AUTO)"),
        (motors, f"controller {status.controller}"),
        (status.execution == "stopped", f"RAPID {status.execution} (expected stopped)"),
        (True, f"speed ratio {status.speed_ratio} %"),
    ]


async def _guidance(settings: Settings) -> list[Finding]:
    egm = settings.egm
    if settings.robot.link == "socket":
        where = f"{settings.socket.host}:{settings.socket.motion_port} and :{settings.socket.guard_port}"
        return [(True, f"RAPID sockets at {where}, not opened: opening them is the program's start")]
    with contextlib.closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as probe:
        try:
            probe.bind((egm.bind, egm.port))
        except OSError as error:
            return [(False, f"UDP {egm.bind}:{egm.port} cannot be listened on: {error}")]
    return [(True, f"UDP {egm.bind}:{egm.port} is free; the controller's UCdevice must send to it")]


async def _text_gripper(settings: Settings) -> list[Finding]:
    """In text mode the gripper sends its state and width, and tells neither homing nor limits."""
    gripper = GclGripper(settings.gripper)
    try:
        await gripper.connect()
        state, width_mm = gripper.state, gripper.width_mm
    finally:
        await gripper.close()
    assert state is not None
    fault = state is GraspingState.ERROR
    return [
        (not fault, "grasping state ERROR: a fault is latched" if fault else "no fault"),
        (True, f"grasping state {state.name}, width {width_mm:.1f} mm"),
        (True, "text mode: homing and the gripper's own limits are not told, look at its web page"),
    ]


async def _gripper(settings: Settings) -> list[Finding]:
    if settings.gripper.protocol == "text":
        return await _text_gripper(settings)
    gripper = Wsg50(settings.gripper)
    try:
        await gripper.connect()
        width_mm, state, limits = await gripper.width_mm(), gripper.state, gripper.limits
    finally:
        await gripper.close()
    assert limits is not None
    assert state is not None
    faults = gripper.system & codec.FAULT_BITS
    homed = SystemState.REFERENCED in gripper.system
    force_n = settings.gripper.force_limit_n
    return [
        (not faults, f"faults: {faults.name or 'none'}" if faults else "no fault"),
        (homed, "homed" if homed else "not homed: run `python -m robot_client home --live` with empty fingers"),
        (limits.force_n[0] <= force_n <= limits.force_n[1], f"force limit {force_n:g} N of {limits.force_n} N"),
        (True, f"grasping state {GraspingState(state).name}, width {width_mm:.1f} mm"),
    ]


async def _service(settings: Settings) -> list[Finding]:
    """Greet as a watcher, which can drive nothing."""
    link = ServiceLink(settings.service, "check")
    answers: asyncio.Queue[Event] = asyncio.Queue()
    await link.start(answers.put_nowait)
    link.send(wire.ClientHello(insertion_id="check", client="robot client check", role="watch"))
    try:
        answer = await asyncio.wait_for(answers.get(), settings.service.connect_timeout_s)
    finally:
        await link.close()
    if isinstance(answer, Failure):
        raise DriverError(f"{answer.code}: {answer.detail}")
    if not isinstance(answer, FromService) or not isinstance(answer.message, wire.ServiceHello):
        raise DriverError(f"answered {answer}, expected its hello")
    hello = answer.message
    findings = [(True, f"protocol {hello.protocol}, controller {hello.controller}")]
    findings += [(True, f"model {entry.card.name} {entry.sha256[:12]}") for entry in hello.models]
    findings += [(camera.state == "live", f"camera {camera.finger} {camera.state}") for camera in hello.cameras]
    return findings
