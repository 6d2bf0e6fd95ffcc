"""A simulated cell at work: the cell, the service with its page and the robot client's cycle, until Ctrl-C."""

import contextlib
import json
import shutil
import time
import webbrowser
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from simulation.cell.children import Child
from simulation.cell.run import SERVICE_READY_S, RunOptions, Start, client_config, ready_cell, start_cell, start_service

OPEN_MM = 100.0
DAYS_S = 1e9


@dataclass(frozen=True)
class DemoOptions(RunOptions):
    """Insert one object after another in the simulated cell, each with a start of its own, until Ctrl-C."""

    port: int = 8000
    """Of the page; any free one if it is taken."""
    open: bool = False
    """Open the page in the browser."""
    parts: int | None = None
    """Stop after so many inserted objects."""


def cycle_config(facts: dict[str, object]) -> list[str]:
    """The taught part of the client's configuration: the fixture is where the arm stands at the start."""
    home = facts["home"]
    lines = ["[cycle]", f"open_mm = {OPEN_MM}"]
    assert isinstance(home, dict)
    lines += ["[cycle.pick]", *(f"{key} = {json.dumps(round(float(value), 4))}" for key, value in home.items())]
    return lines


def lines(options: DemoOptions, folder: Path, log: Path | None = None) -> Iterator[str]:
    """Run the demonstration and give what it says; raises ChildError if a process fails. Ends all on leaving."""
    start = Start(options.object, 0.0, 0.0, options.seed)
    folder.mkdir(parents=True)
    with ExitStack() as children:
        yield "starting the simulated cell"
        cell = children.enter_context(start_cell(start, options, folder, fed=True))
        facts = ready_cell(cell, folder)
        service = children.enter_context(_service(facts, options, folder))
        url = service.until("service ready at ", SERVICE_READY_S).rsplit(" ", 1)[1]
        yield f"page: {url}"
        if options.open:
            with contextlib.suppress(webbrowser.Error):
                webbrowser.open(url)
        config = folder / "client.toml"
        told = [*client_config(start, facts, url, options, folder), *cycle_config(facts)]
        config.write_text("\n".join(told) + "\n")
        counted = ("--parts", str(options.parts)) if options.parts else ()
        arguments = ["cycle", "--live", "--config", str(config), "--logs", str(log or folder / "episodes"), *counted]
        client = children.enter_context(Child("robot client", "robot_client", arguments, folder / "client.log"))
        yield from client.lines((cell, service), DAYS_S)
        if client.code not in {0, 1}:
            client.check()
        if client.code == 1:
            yield "the cell holds; the page says why. Ctrl-C ends the demonstration"
            while True:
                cell.check()
                service.check()
                time.sleep(0.5)


def _service(facts: dict[str, object], options: DemoOptions, folder: Path) -> Child:
    """On the port asked for, or on any other where that is taken."""
    service = start_service(facts, options, folder, options.port)
    deadline_s = time.monotonic() + 5.0
    while service.code is None and time.monotonic() < deadline_s and "service" not in service.tail():
        time.sleep(0.1)
    if service.code is not None and "cannot listen" in service.tail():
        shutil.copy(service.log, service.log.with_suffix(".first.log"))
        return start_service(facts, options, folder, 0)
    return service
