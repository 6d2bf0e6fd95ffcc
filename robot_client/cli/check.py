"""`check`: reads every device that an insertion needs and moves nothing; one line per finding."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Sequence

from robot_client.cli.alone import alone
from robot_client.cli.insert import make_plan, with_commissioning
from robot_client.cli.terminal import Outcome, show
from robot_client.insertion.events import Event, Failure, FromService
from robot_client.insertion.limits import check_pose
from robot_client.ports import Check, DriverError, Finding, Signals
from robot_client.session.commission.record import commissioned
from robot_client.session.runner import leave
from robot_client.session.service_link import ServiceLink
from robot_client.settings import Settings
from service.contract import wire
from service.contract.refusals import reason

NO_TOKEN = "the service names its file at its start; give it as service.token_file"  # noqa: S105 - no token

_UNSURE = "task.neighbours_stay is not true"
MAY_SLIDE = f"{_UNSURE}: after a blocked attempt no insertion is confirmed"
FIX_THEM = f"{_UNSURE}: fix the neighbours for the commissioning, or the known errors of its probes are wrong"


def check(settings: Settings) -> Outcome:
    """Print the findings; done if everything is ready for an insertion."""
    return asyncio.run(_check(settings))


async def _check(settings: Settings) -> Outcome:
    rows = []
    async for name, finding in findings_of(settings):
        rows.append({"check": name, **finding._asdict()})
        show(f"{'ok  ' if finding.good else 'BAD '} {name:9s} {finding.text}")
    ready = all(row["good"] for row in rows)
    show("ready to insert" if ready else "NOT ready")
    return Outcome(ready, {"ready": ready, "findings": rows})


async def findings_of(settings: Settings) -> AsyncIterator[tuple[str, Finding]]:
    """Check the plan, every device and the service; yield each finding with the name of its check; moves nothing.

    Devices that another client uses are left to it: a gripper takes one connection, also between a cycle's steps.
    """
    arm, gripper = settings.make_arm(), settings.make_gripper()
    checks: dict[str, Check] = {
        "plan": lambda: _plan(settings),
        **({"cell": lambda: _commissioned(settings)} if settings.commissioning and not settings.simulated else {}),
        "service": lambda: _service(settings),
    }
    kept = contextlib.ExitStack()
    try:
        kept.enter_context(alone(settings))
    except DriverError as error:
        yield "gripper", Finding(False, str(error))
    else:
        checks |= {**arm.checks(), **gripper.checks()}
        if settings.cycle and settings.cycle.plc and (signals := arm.signals()):
            names = settings.cycle.plc
            checks["plc"] = lambda: _plc(signals, [names.start, names.ready, names.done, names.fault])
    try:
        for name, read in checks.items():
            try:
                findings = await read()
            except (ValueError, TimeoutError) as error:
                findings = [Finding(False, str(error) or "no answer in time")]
            except OSError as error:  # of a driver that does not say what it could not reach
                findings = [Finding(False, f"{name}: {reason(error)}")]
            for finding in findings:
                yield name, finding
    finally:
        await leave(arm, gripper)
        kept.close()


async def _plc(signals: Signals, names: list[str]) -> list[Finding]:
    """Read each signal of the handshake."""
    findings = []
    for name in names:
        try:
            on = await signals.read_signal(name)
        except DriverError as error:
            findings.append(Finding(False, f"signal {name}: {error}"))
        else:
            findings.append(Finding(True, f"signal {name} is {'on' if on else 'off'}"))
    return findings


async def _plan(settings: Settings) -> list[Finding]:
    plan = make_plan(settings, 0.0, 0.0, "check", None)
    bottom = plan.deepest
    check_pose(settings.limits, plan.approach, "approach")
    check_pose(settings.limits, bottom, "full insertion")
    plan.check()
    if settings.cycle:
        settings.cycle.check(settings.limits)
    probing_mm_s, start_mm = settings.ramps.descend.speed_mm_s, plan.approach.z_mm
    legs = plan.pace.legs(start_mm, bottom.z_mm, probing_mm_s, plan.tops) if plan.pause_s else ()
    way = settings.ramps.in_legs(start_mm, legs) if legs else settings.ramps.profile(plan.approach, bottom, "descend")
    text = f"approach z {start_mm:g} mm, full depth z {bottom.z_mm:g} mm, {way.duration_s:.1f} s down"
    unsure = [] if plan.neighbours_stay else [Finding(True, MAY_SLIDE)]
    return [Finding(True, text), *unsure]


async def _commissioned(settings: Settings) -> list[Finding]:
    """The record of the commissioning: what it measured must leave the lease long enough."""
    assert settings.commissioning is not None
    plan = with_commissioning(settings, make_plan(settings, 0.0, 0.0, "check", None), asked=True)
    plan.lease.check(plan.ramps.descend.speed_mm_s)
    late_s, fast_mm_s = commissioned(settings.commissioning).late_s, plan.pace.fast_mm_s
    lasts = f"the lease lasts {1e3 * plan.lease.lasts_s(plan.ramps.descend.speed_mm_s):.0f} ms"
    if fast_mm_s is not None and not plan.fast_lease.bears(fast_mm_s):
        lasts += f", too short for {fast_mm_s:g} mm/s: fast legs are slower, or there are none"
    if late_s is None:
        late = f"how late pictures and arm are was not measured: for the {1e3 * plan.lease.stop_lag_s:.0f} ms set"
        return [Finding(True, f"commissioned; {late}, {lasts}")]
    return [Finding(True, f"commissioned; pictures and arm are late by at most {1e3 * late_s:.0f} ms: {lasts}")]


async def hello_of(settings: Settings) -> wire.ServiceHello:
    """The service's hello to a watcher, who can drive nothing; raises DriverError, TimeoutError."""
    link = ServiceLink(settings.service, "check")
    answers: asyncio.Queue[Event] = asyncio.Queue()
    await link.start(answers.put_nowait)
    link.send(wire.ClientHello(insertion_id="check", client="robot client check", role="watch"))
    try:
        async with asyncio.timeout(settings.service.connect_timeout_s):
            answer = await answers.get()
    finally:
        await link.close()
    if isinstance(answer, Failure):
        raise DriverError(f"{answer.code}: {answer.detail}")
    if not isinstance(answer, FromService) or not isinstance(answer.message, wire.ServiceHello):
        raise DriverError(f"answered {answer}, expected its hello")
    return answer.message


async def _service(settings: Settings) -> list[Finding]:
    hello = await hello_of(settings)
    known = settings.service.token() is not None
    return [
        Finding(known, "token for driving found" if known else f"no token for driving: {NO_TOKEN}"),
        Finding(True, f"protocol {hello.protocol}, controller {hello.controller}"),
        *(Finding(True, f"model {entry.card.name} {entry.sha256[:12]}") for entry in hello.models),
        *(Finding(camera.state == "live", f"camera {camera.finger} {camera.state}") for camera in hello.cameras),
        *(Finding(False, f"{camera.finger} gel: {camera.gel_doubt}") for camera in hello.cameras if camera.gel_doubt),
        examine_cameras(settings, hello.cameras),
    ]


def examine_cameras(settings: Settings, cameras: Sequence[wire.CameraEntry]) -> Finding:
    """Whether an insertion would begin with these cameras and gels."""
    asked = settings.commissioning is not None
    try:
        with_commissioning(settings, make_plan(settings, 0.0, 0.0, "check", None), asked=asked).check_cameras(cameras)
    except ValueError as error:
        return Finding(False, str(error))
    timed = bool(cameras) and all(camera.frame_rate_hz is not None for camera in cameras)
    fast = "cameras fast enough" if timed else "cameras: how fast they are is not known yet"
    return Finding(True, fast + (", gels as commissioned" if asked else ""))
