"""`cycle`: parts one after the other, from the pick to the release; rehearses one part without --live."""

import asyncio
import contextlib
import os
import signal
import sys
from functools import partial
from pathlib import Path

from robot_client.cli.insert import live_ports, make_plan, regrasp_of, way_of, with_commissioning
from robot_client.cli.terminal import Outcome, rehearsed, show, show_steps, stop_on_signals, warning
from robot_client.insertion.state import Phase, Plan, State
from robot_client.ports import DriverError
from robot_client.session.afresh import new_id, upright
from robot_client.session.cycle import Count, Cycle, CycleSettings, Pace
from robot_client.session.handshake import Handshake
from robot_client.session.recorder import Recorder, check_takes_files
from robot_client.session.report import Report
from robot_client.session.runner import Runner
from robot_client.session.travel import pose_text
from robot_client.settings import Settings, SettingsError
from service.contract.refusals import reason


def cycle(settings: Settings, *, live: bool, asked: bool, parts_n: int | None, log: Path | None) -> Outcome:
    """Insert ``parts_n`` parts (None: until stopped); done if each was inserted. Raises DriverError, LimitError."""
    taught = settings.cycle
    if taught is None:
        raise SettingsError("cycle: the configuration lacks the table [cycle] with pick and open_mm")
    taught.check(settings.limits)
    plan = make_plan(settings, 0.0, 0.0, None, None)
    if live:
        plan = with_commissioning(settings, plan, asked=asked)
    plan.check()  # before anything is picked
    if live and log:
        check_takes_files(log)
    show(warning(live=live, simulated=settings.simulated))
    steps = _steps(settings, taught, plan)
    if not live:
        return rehearsed("would, for each part:", steps)
    show_steps("will, for each part:", steps)
    return asyncio.run(_cycle(settings, taught, parts_n, log, plan))


def _steps(settings: Settings, taught: CycleSettings, plan: Plan) -> list[str]:
    """The steps of a part; `insert` without --live rehearses the insertion itself."""
    rejected = f"carry it to {pose_text(taught.reject)}, and let go" if taught.reject else "hold with it in the hand"
    turned = "put it back at the pick, which has to be empty still" if taught.regrasp else "as if not inserted"
    asked = "only when the PLC asks for it" if taught.plc else "AT ONCE: the gap has to be free again by itself"
    return [
        f"open to {taught.open_mm:g} mm and go to {pose_text(taught.pick)}",
        f"close on the object, insert it {settings.task.expected_depth_mm:g} mm deep: {way_of(plan)}",
        f"open to {taught.open_mm:g} mm, {taught.retreat_mm:g} mm straight up, close on nothing",
        f"if it has turned in the hand: {turned}",
        f"if it is not inserted: {rejected}",
        f"begin the next part {asked}",
    ]


async def _cycle(
    settings: Settings, taught: CycleSettings, parts_n: int | None, log: Path | None, first: Plan
) -> Outcome:
    fixture = regrasp_of(settings)

    async def insert(number: int) -> State:
        plan = first.model_copy(update={"insertion_id": new_id()})
        return await upright(plan, partial(run, number), fixture, lambda text: show(f"  {text}"))

    async def run(number: int, plan: Plan) -> State:
        show(f"  insertion {plan.insertion_id}")
        arm, gripper, service = live_ports(settings, plan)
        report = Report(arm.position, lambda text: show(f"  {text}"))
        written = log / f"{plan.insertion_id}.jsonl" if log else None
        runner = Runner(plan, arm, gripper, service, Recorder(written, plan), (report,), settings.simulated)
        state = await runner.run()
        if state.phase is not Phase.INSERTED:
            show(f"  robot: {runner.farewell}")
        if runner.recorder.lost:
            show(f"  log {written} BROKEN OFF: {runner.recorder.lost}")
        runner.check_stopped()  # before anything else moves, the fingers included
        if not state.done or state.reason.startswith("operator:"):
            raise DriverError(f"part {number}: interrupted, the arm holds")
        return state

    signals = settings.make_arm().signals() if taught.plc else None
    if taught.plc and signals is None:
        raise SettingsError("cycle.plc: this robot has no signals")
    plc = Handshake(taught.plc, signals) if taught.plc and signals else None
    stop_on_signals()
    running = Cycle(taught, settings.errands, insert, show, plc=plc)
    _take_orders(running.pace)
    try:
        await running.run(parts_n)
    except (ValueError, OSError) as error:  # the latter of a driver that does not say what it could not reach
        show(f"HOLD  {reason(error)}")
        show(str(running.count))
        return Outcome(False, _result(running.count) | {"reason": reason(error)})
    show(str(running.count))
    return Outcome(True, _result(running.count))


def _result(count: Count) -> dict[str, int | str]:
    return {"inserted": count.inserted_n, "rejected": count.rejected_n}


def _take_orders(pace: Pace) -> None:
    """From the terminal: pause, resume, stop. From another program: SIGUSR1 pauses, SIGRTMIN resumes, SIGUSR2 stops.

    No signal does both: who sends one does not see whether the cycle is paused, and a pause sent twice must not move.
    """
    loop = asyncio.get_running_loop()

    def order(word: str) -> None:
        show(pace.order(word))

    def read() -> None:
        typed = b""
        with contextlib.suppress(OSError):  # in the background the terminal is the shell's
            typed = os.read(sys.stdin.fileno(), 4096)  # after Ctrl-D no line's end comes, and the arm cannot wait
        if typed:
            order(typed.decode(errors="replace"))
        else:
            loop.remove_reader(sys.stdin)
            show(f"no orders are read from the terminal any more. Signals to process {os.getpid()}:")
            show("SIGUSR1 pauses, SIGRTMIN resumes, SIGUSR2 stops after this part, SIGINT holds")

    signal.signal(signal.SIGTTIN, signal.SIG_IGN)  # to read there would stop the process, and guidance with it
    if sys.stdin is not None and sys.stdin.isatty():
        with contextlib.suppress(OSError, ValueError, PermissionError):
            loop.add_reader(sys.stdin, read)
            show("type pause, resume or stop (after this part) and Enter; Ctrl-C holds the arm at once")
    for number, word in ((signal.SIGUSR1, "pause"), (signal.SIGRTMIN, "resume"), (signal.SIGUSR2, "stop")):
        loop.add_signal_handler(number, order, word)
