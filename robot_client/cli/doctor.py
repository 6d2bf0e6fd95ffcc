"""`doctor`: names faults of the PC, the network, the controller, the gripper and the cameras, with their remedies."""

import asyncio
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from rich import box
from rich.console import Console
from rich.table import Table

from robot_client.cli.check import findings_of
from robot_client.cli.remedies import remedy_of
from robot_client.cli.terminal import Outcome, show
from robot_client.ports import Finding
from robot_client.settings import Settings, SettingsError, load_settings
from service.contract.text import printable

AREAS = {"robot": "controller", "guidance": "network", "plan": "limits", "plc": "controller", "service": "service"}
CORES_N, FREE_GB, BUSY = 2, 1.0, 0.9
WIDTH = 80


class Row(NamedTuple):
    """One line of the table; ``remedy`` only for a fault."""

    area: str
    good: bool
    text: str
    remedy: str = ""


def doctor(config: Path | None, overrides: dict[str, Any], recordings: Path) -> Outcome:
    """Print the table; done if nothing prevents an insertion. Moves nothing."""
    rows = [_row("pc", finding) for finding in examine_pc(recordings)]
    try:
        settings = load_settings(config, overrides)
    except SettingsError as error:
        rows.append(_row("limits", Finding(False, str(error))))
    else:
        rows += asyncio.run(examine(settings))
    Console(width=_columns()).print(grid(rows))
    wrong_n = sum(not row.good for row in rows)
    show("nothing is wrong" if not wrong_n else f"{wrong_n} of {len(rows)} need a remedy")
    return Outcome(not wrong_n, {"rows": [row._asdict() for row in rows]})


async def examine(settings: Settings) -> list[Row]:
    """Findings of every device and the service."""
    return [_row(_area(name, finding), finding) async for name, finding in findings_of(settings)]


def examine_pc(recordings: Path) -> Iterator[Finding]:
    cores_n = os.cpu_count() or 1  # of the PC: a client that is kept to one of them has it for itself
    yield Finding(cores_n >= CORES_N, f"{cores_n} processor cores (expected {CORES_N} or more)")
    load = os.getloadavg()[0] / cores_n
    yield Finding(load <= BUSY, f"load {load:.0%} of all cores (expected up to {BUSY:.0%})")
    folder = recordings
    while not os.access(folder, os.F_OK):  # nor where this user may not look
        folder = folder.parent
    free_gb = shutil.disk_usage(folder).free / 1e9
    yield Finding(free_gb >= FREE_GB, f"{free_gb:.1f} GB free for recordings (expected {FREE_GB:g} or more)")
    writable = os.access(folder, os.W_OK | os.X_OK) and folder.is_dir()
    yield Finding(writable, f"recordings may {'' if writable else 'not '}be written to {recordings}")


def grid(rows: list[Row]) -> Table:
    """The rows for a terminal, faults first."""
    shown = Table(box=box.SIMPLE, width=_columns(), pad_edge=False)
    for heading in ("", "where", "what", "remedy"):
        shown.add_column(heading, overflow="fold")
    for row in sorted(rows, key=lambda row: row.good):
        state = "[green]ok[/]" if row.good else "[red]BAD[/]"
        shown.add_row(state, row.area, _plain(row.text), _plain(row.remedy))
    return shown


def _columns() -> int:
    return min(WIDTH, shutil.get_terminal_size().columns)


def _plain(text: str) -> str:
    """Text of a device, with terminal control characters and table markup escaped."""
    return printable(text).replace("[", r"\[")


def _area(name: str, finding: Finding) -> str:
    """Area of a finding: an unreachable device is a matter of the network."""
    text = finding.text.lower()
    answered = re.search(r"http \d", text) is not None
    if (
        not finding.good
        and not answered
        and any(word in text for word in ("connect", "timeout", "no answer", "refused", "unreach"))
    ):
        return "network"
    if name == "service" and ("camera" in text or " gel is" in text):
        return "camera"
    return AREAS.get(name, name)


def _row(area: str, finding: Finding) -> Row:
    return Row(area, finding.good, finding.text, "" if finding.good else remedy_of(finding.text))
