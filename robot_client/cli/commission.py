"""`commission`: the first day of a cell, by probes from known errors; a dry run without --live."""

import asyncio
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from robot_client.cli.check import FIX_THEM, hello_of
from robot_client.cli.insert import fixture_of, live_ports, make_plan
from robot_client.cli.terminal import Outcome, rehearsed, show, show_steps, stop_on_signals, warning
from robot_client.insertion.state import Phase, Plan
from robot_client.ports import DriverError, Gripper
from robot_client.session.commission.answers import Answered, Answers
from robot_client.session.commission.kept_gripper import KeptGripper
from robot_client.session.commission.lateness import slow_and_fast
from robot_client.session.commission.pictures import picture_of
from robot_client.session.commission.record import RECORD, Record, read_record
from robot_client.session.commission.run import FITS, REACH, Commissioning, Ended, errors, second_grip_n
from robot_client.session.commission.steps import left_of, steps_of
from robot_client.session.commission.taught import CELL, teach
from robot_client.session.commission.wiring import SIDES
from robot_client.session.cycle import CycleSettings, is_empty
from robot_client.session.recorder import Recorder, check_takes_files
from robot_client.session.runner import Runner, close_gripper, closed_after
from robot_client.session.stops import StopWatch
from robot_client.settings import Settings, SettingsError, Task
from service.contract import wire
from service.contract.frames import Finger
from service.contract.refusals import reason

SCALED = ("grip_n", "shear_reach_mm")  # of the task, measured at the set grip and in proportion to it
RATE_HZ = 30.0  # of cameras that have not told theirs


def commission(settings: Settings, *, live: bool, probes_n: int, seed: int, out: Path, one_grip: bool) -> Outcome:
    """Probe ``probes_n`` times, first for signs; done if no mistake was named. Raises DriverError.

    ``one_grip``: press until the gel slides at the set grip alone, see `Commissioning`.
    """
    taught = settings.cycle
    if taught is None:
        raise SettingsError("commission: the configuration lacks the table [cycle] with pick and open_mm")
    if not taught.regrasp:
        raise SettingsError(
            "cycle.regrasp = false: a commissioning puts the object back into its fixture, which must not fill up"
            " again: stop the feeder, and set cycle.regrasp = true for that time"
        )
    taught.check(settings.limits)
    for x_mm, theta_deg in (*SIDES, REACH, (-REACH[0], -REACH[1])):
        make_plan(settings, x_mm, theta_deg, None, None).check()
    path = out / RECORD
    record = read_record(path)
    if live:
        check_takes_files(out)
    show(warning(live=live, simulated=settings.simulated))
    grips_n = grips_of(settings, one_grip=one_grip)
    left = left_of(record, probes_n, grips_n)
    if left and not settings.task.neighbours_stay:
        show(FIX_THEM)
    steps = steps_of(probes_n, path, record, grips_n)
    if not live:
        return rehearsed("would:", steps)
    if record is None:
        begun, task = time.strftime("%Y-%m-%dT%H:%M:%S"), settings.task
        record = Record(begun=begun, seed=seed, object=task.object, approach_z_mm=task.approach_z_mm)
    elif record.named:
        raise SettingsError(f"{path} names mistakes; mend them and remove it: {'; '.join(record.named)}")
    else:
        _check_goes_on(path, record, settings.task)
    opens = f", after it has opened the empty fingers to {taught.open_mm:g} mm"
    show_steps(f"will{opens if left else ''}:", steps)
    return asyncio.run(_commission(Probing(settings, taught, out), probes_n, path, record, grips_n))


def _check_goes_on(path: Path, record: Record, task: Task) -> None:
    """Raise SettingsError for another object, or another height amid the signs: the gap would be taught from both."""
    if record.object != task.object:
        which = f"{path} was begun with task.object = {record.object!r}, which is {task.object!r} now"
        raise SettingsError(f"{which}: set it back, or name another folder (--out)")
    begun_mm, signs_n = record.approach_z_mm, len(record.signs)
    if begun_mm is not None and signs_n < len(SIDES) and begun_mm != task.approach_z_mm:
        which = f"{path} was begun with task.approach_z_mm = {begun_mm:g}, which is {task.approach_z_mm:g} now"
        raise SettingsError(f"{which}, and its {len(SIDES)} signs are not complete: set it back, or begin anew")


def grips_of(settings: Settings, *, one_grip: bool) -> list[float | None]:
    """The grips to press at, N, the set one first; None where the gripper's force cannot be set."""
    key = settings.gripper.grip_key
    if not key:
        return [None]
    own_n = float(getattr(settings.gripper, key))
    return [own_n] if one_grip else [own_n, second_grip_n(own_n)]


def with_grip(settings: Settings, grip_n: float | None) -> Settings:
    """The same cell with another grip; what was measured under the set one is taken to change by as much."""
    if grip_n is None:
        return settings
    key, task = settings.gripper.grip_key, settings.task
    share = grip_n / float(getattr(settings.gripper, key))
    scaled = {name: value and share * value for name in SCALED if (value := getattr(task, name)) is not None}
    gripper = settings.gripper.model_copy(update={key: grip_n})
    return settings.model_copy(update={"gripper": gripper, "task": task.model_copy(update=scaled)})


class Probing:
    """One probe, and the way to the fixture and back, on the configured devices."""

    def __init__(self, settings: Settings, taught: CycleSettings, out: Path) -> None:
        self._settings, self._taught, self._out = settings, taught, out
        self._rate_hz, self._kept = RATE_HZ, KeptGripper(settings.make_gripper())
        self.late_s: Callable[[], float | None] = lambda: None  # as far as it is measured

    async def probe(self, x_mm: float, theta_deg: float) -> Ended:
        return await self._run(self._probed(self._settings, x_mm, theta_deg), self._settings.make_gripper())

    async def several(self, places: Sequence[tuple[float, float]], answered: Callable[[Answered], None]) -> Ended:
        """Probes at these errors with one grasp, each with the object held upright: the signs are known."""
        first, *others = (self._probed(self._settings, *place) for place in places)
        starts = tuple(plan.approach for plan in others)
        plan = first.model_copy(update={"starts": starts, "signs_known": True})
        return await self._run(plan, self._settings.make_gripper(), answered)

    async def press(self, grip_n: float | None, x_mm: float, theta_deg: float) -> Ended:
        """A probe that goes on until the gel slides, with this grip."""
        gripping = with_grip(self._settings, grip_n)
        plan = self._probed(gripping, x_mm, theta_deg).model_copy(update={"until_slip": True})
        ended = await self._run(plan, gripping.make_gripper())
        return ended._replace(probes=tuple(one.model_copy(update={"grip_n": grip_n}) for one in ended.probes))

    async def press_at(self, x_mm: float, theta_deg: float, fast: bool) -> Ended:
        plan = make_plan(self._settings, x_mm, theta_deg, None, None)
        return await self._run(slow_and_fast(plan, self._rate_hz)[fast], self._kept)

    async def picture(self, insertion_id: str, caption: str) -> str:
        return await picture_of(self._settings.service, insertion_id, caption)

    def teach(self, record: Record, path: Path) -> None:
        """Write the configuration of the commissioned cell beside its record."""
        text = teach(self._settings.tables(), record, path)
        show(f"{text}; `insert --live --config {path.with_name(CELL)}` reads that")

    async def gels(self) -> dict[Finger, str]:
        """Those of the service now, by its names; raises DriverError if it does not answer."""
        return {camera.finger: camera.gel for camera in (await self._hello()).cameras}

    async def _hello(self) -> wire.ServiceHello:
        try:
            return await hello_of(self._settings)
        except TimeoutError:
            raise DriverError(f"service: {self._settings.service.url} has not answered in time") from None

    async def allowed(self, grips_n: Sequence[float | None]) -> list[float | None]:
        """Those of the grips that the gripper and the service's networks allow; says which they do not.

        Moves nothing, raises DriverError.
        """
        kept, trained = list(grips_n), [entry.card.pressing for entry in (await self._hello()).models]
        for grip_n in grips_n[1:]:
            stated = {name: getattr(with_grip(self._settings, grip_n).task, name) for name in SCALED}
            if why := next((why for one in trained if one and (why := one.outside(stated))), ""):
                show(f"PRESSES AT ONE GRIP ONLY: {why}")
                kept.remove(grip_n)
                continue
            async with closed_after(with_grip(self._settings, grip_n).make_gripper()) as gripper:
                findings = [finding for read in gripper.checks().values() for finding in await read()]
            for finding in findings:
                if not finding.good and finding.text.startswith(self._settings.gripper.grip_key):
                    show(f"PRESSES AT ONE GRIP ONLY: {finding.text}")
                    kept.remove(grip_n)
        return kept

    def _probed(self, settings: Settings, x_mm: float, theta_deg: float) -> Plan:
        plan = make_plan(settings, x_mm, theta_deg, None, None)
        return plan.model_copy(update={"purpose": "probe", "lease": plan.lease.late_by(self.late_s())})

    async def _run(self, plan: Plan, gripper: Gripper, answered: Callable[[Answered], None] = lambda _: None) -> Ended:
        answers, watch = Answers(plan, answered), StopWatch()
        log = Recorder(self._out / "episodes" / f"{plan.insertion_id}.jsonl", plan)
        arm, _, service = live_ports(self._settings, plan)
        runner = Runner(plan, arm, gripper, service, log, (answers, watch), self._settings.simulated)
        state = await runner.run()
        if state.phase is not Phase.PROBED:
            show(f"  robot: {runner.farewell}")
        if log.lost:
            show(f"  log {log.path} BROKEN OFF: {log.lost}")
        runner.check_stopped()  # before anything else moves, the fingers included
        self._rate_hz = min(answers.rates_hz, default=self._rate_hz)
        if state.phase is Phase.PROBED and len(answers.probes) < state.attempt:
            answers.take(None)
        measured: dict[str, float | None] = {"slid_mm": answers.slid_mm} if plan.until_slip else {}
        if watch.stop and not plan.starts:
            measured |= {"below_mm": watch.stop.touch_mm - plan.clearance_mm, "touch_mm_s": watch.stop.speed_mm_s}
        probes = tuple(probe.model_copy(update=measured) for probe in answers.probes)
        return Ended(probes, state.phase, state.reason, answers.gels, watch.stop)

    async def begin(self) -> None:
        """Open the empty hand, which goes down to the fixture next; raises DriverError if it holds something."""
        with_gripper = self._settings.errands.with_gripper
        if not await with_gripper(lambda gripper: is_empty(gripper, self._taught.open_mm)):
            raise DriverError("gripper: holds something; put the object into the fixture and open the fingers")
        await with_gripper(lambda gripper: gripper.release(self._taught.open_mm))

    async def leave(self, *, ends: bool = False) -> None:
        """Release the gripper's connection if presses have kept it; raises DriverError, unless all ``ends`` anyway."""
        kept, self._kept = self._kept, KeptGripper(self._settings.make_gripper())
        await close_gripper(kept.leave(), failed=ends)

    async def fetch(self) -> None:
        """Put the object back into the fixture, if held, and open; the next probe regrasps it."""
        await self.leave()
        fixture = fixture_of(self._settings)
        assert fixture is not None
        await fixture.put_back()


async def _commission(
    probing: Probing, probes_n: int, path: Path, record: Record, grips_n: Sequence[float | None]
) -> Outcome:
    stop_on_signals()
    draw = errors(record.seed, *REACH, FITS)
    press, press_at, picture = probing.press, probing.press_at, probing.picture
    several, fetch = probing.several, probing.fetch
    running = Commissioning(
        path, record, probing.probe, several, fetch, draw, show, press, press_at=press_at, picture=picture
    )
    probing.late_s = lambda: running.record.late_s
    why = ""
    try:
        if record.gels:  # also where no probe is left to notice another one
            running.check_gels(await probing.gels(), "before any probe")
        if left_of(record, probes_n, grips_n):
            running.grips_n = await probing.allowed(grips_n)
        if left_of(record, probes_n, running.grips_n):
            await probing.begin()
        record = await running.run(probes_n)
        if not record.named:
            probing.teach(record, path)
        await probing.leave()
    except (ValueError, OSError) as error:
        record, why = running.record, reason(error)
        show(f"HOLD  {why}")
    finally:
        await probing.leave(ends=True)
    for cause in record.named:
        show(f"MISTAKE  {cause}")
    if record.late_s is not None:
        show(f"pictures and arm are late by at most {record.late_s * 1e3:.0f} ms together; `insert` reckons with that")
    if running.stale_n:
        show(
            f"{running.stale_n} attempts told nothing: the arm paused in them for want of a judged frame. Fewer pause"
            " on a PC with less to do, or with a slower [ramps.descend] speed_mm_s; insertions likewise"
        )
    if record.done_n >= probes_n and not why:
        show(f"{record.done_n} probes done. The service's recordings hold them; to learn from them:")
        out = f"--out runs/adapted_{record.begun[:10]}"
        show(f"  python -m training adapt RECORDINGS --record {path} --from models/pressing/checkpoint.pt {out}")
    kept = _kept(path)
    show(f"record: {kept or 'none, no probe was completed'}")
    result = {"named": list(record.named), "probes": record.done_n, "record": kept, "reason": why}
    return Outcome(not record.named and not why, result)


def _kept(path: Path) -> str | None:
    """The record's path, None if nothing was written there: the first probe failed, or the hand was not empty."""
    return str(path) if path.exists() else None
