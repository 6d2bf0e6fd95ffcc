"""Replays an episode log: the same events through the same machine must give the same commands."""

from pathlib import Path
from typing import Any

from robot_client.insertion.events import Begin, Command, Event, Grasp, Hold, Move, Renew, Send
from robot_client.insertion.machine import step
from robot_client.insertion.state import State
from robot_client.session.recorder import read_log
from robot_client.session.report import Report


class ReplayError(ValueError):
    """The log and today's machine disagree; the text names the first difference."""


def replay(path: Path, show: Any = print) -> State:
    """Play ``path`` through the state machine and print it; raises ReplayError or ContractError.

    Commands are compared with the logged ones in full, so that a change of behaviour cannot hide.
    """
    plan, entries, end = read_log(path)
    state, report = State(plan), Report(lambda: None, show)
    expected: list[Command] = []
    start_s: float | None = None
    for number, entry in enumerate(entries, 2):
        if isinstance(entry, Grasp | Hold | Move | Renew | Send):
            if not expected or expected.pop(0) != entry:
                raise ReplayError(f"{path}, line {number}: logged {entry.kind}, the machine orders something else")
            continue
        if expected:
            raise ReplayError(f"{path}, line {number}: the machine orders {expected[0].kind}, the log does not")
        if isinstance(entry, Begin):
            start_s = entry.at_s
        state, commands = step(state, entry)
        expected = list(commands)
        _print(show, entry, state, start_s)
        report.on_event(state, entry)
    if end and end.get("phase") != str(state.phase):
        raise ReplayError(f"{path}: the log ends {end.get('phase')}, the machine ends {state.phase}")
    link, rest = (end[name] if isinstance(end.get(name), dict) else {} for name in ("link", "rest"))
    for line in report.final(state, str(end.get("controller", "log was cut")), link, rest):
        show(line)
    return state


def _print(show: Any, event: Event, state: State, start_s: float | None) -> None:
    name: str = event.kind
    message = getattr(event, "message", None)
    if message is not None:
        if message.type in {"heartbeat", "watching"}:
            return
        name = f"service {message.type}"
    show(f"{event.at_s - (start_s or event.at_s):8.3f} s  {name:20s} -> {state.phase}")
