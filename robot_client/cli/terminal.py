"""Shared parts of the commands: printing, the warning before a motion, and an orderly end on interruption."""

import asyncio
import os
import signal
import sys
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, TextIO

from service.contract.text import WIDTH, fitted, printable

NOT_A_SAFETY_FUNCTION = "LIVE: this moves a real robot. It is not a safety function; the cell's guards and stops are."
SIMULATED = "SIMULATED CELL: the orders are real, the robot is not."
DRY_RUN = "DRY RUN: nothing is connected, nothing moves (type --live to move)."
_LINES = ThreadPoolExecutor(1, "terminal")


class Outcome(NamedTuple):
    """How a command ended: whether it did its job, and the result that ``--json`` prints."""

    done: bool
    result: dict[str, Any]


def show(text: str, *, whole: bool = False) -> None:
    """Print a line, with terminal control characters escaped: devices and services send texts, too.

    It is wrapped to the terminal, less the two columns that `run` needs, unless ``whole``. Once the terminal is gone,
    nothing is printed any more, and nothing else changes. Nor does an event loop ever wait for a terminal that takes
    no more lines, as after Ctrl-S: it guides an arm. :func:`printed` waits for all lines.
    """
    line = printable(text) if whole else fitted(printable(text), width=WIDTH - 2)
    printing = _LINES.submit(_print, line, sys.stdout)
    if not _in_event_loop():
        printing.result()


def printed() -> None:
    """Wait until every line is printed."""
    _LINES.submit(int).result()


def _print(line: str, output: TextIO) -> None:
    try:
        print(line, file=output, flush=True)
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), output.fileno())  # the rest of the buffer goes there


def _in_event_loop() -> bool:
    try:
        asyncio.get_running_loop()
    except RuntimeError:
        return False
    return True


def warning(*, live: bool, simulated: bool) -> str:
    """The warning before anything may move."""
    if not live:
        return DRY_RUN
    return SIMULATED if simulated else NOT_A_SAFETY_FUNCTION


def show_steps(heading: str, steps: list[str]) -> None:
    """Print what comes, before anything of it does."""
    show(heading)
    for step in steps:
        show(f"  {step}")


def rehearsed(heading: str, steps: list[str]) -> Outcome:
    """Print the steps of a live run; done."""
    show_steps(heading, steps)
    return Outcome(True, {"live": False, "steps": steps})


def stop_on_signals() -> None:
    """Ctrl-C, SIGTERM and a terminal hang-up (except under `nohup`) hold the arm and end the command in order.

    So do the signals that a cycle takes as orders: another command cannot pause, and their default is to kill it.
    """
    task = asyncio.current_task()
    assert task is not None
    loop = asyncio.get_running_loop()
    hang_up = () if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN else (signal.SIGHUP,)
    orders = (signal.SIGUSR1, signal.SIGUSR2, signal.SIGRTMIN)
    for number in (signal.SIGINT, signal.SIGTERM, *hang_up, *orders):
        loop.add_signal_handler(number, task.cancel)
