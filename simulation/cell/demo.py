"""A simulated cell at work: the cell, the service with its page and the robot client's cycle, until Ctrl-C."""

import contextlib
import socket
import time
import webbrowser
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from service.contract.token import TOKEN_FILE
from simulation.cell.children import Child, Children
from simulation.cell.config import client_config
from simulation.cell.emulators.net import HOST, BusyPortError, bind_tcp, free_port, port_of
from simulation.cell.run import SERVICE_READY_S, LiveOptions, RunError, Start, ready_cell, start_cell, start_service

DAYS_S = 1e9


@dataclass(frozen=True)
class DemoOptions(LiveOptions):
    """Insert one object after another in the simulated cell, each from its own start, until Ctrl-C."""

    port: int = 8000
    """Port of the page; any free one if it is taken."""
    open: bool = False
    """Open the page in the browser."""
    parts: int | None = None
    """Stop after this many inserted objects; never if left out."""

    def check(self) -> None:
        """Raise also for a port or a number of objects that cannot be."""
        super().check()
        if not 0 <= self.port <= 65535:
            raise RunError(f"--port {self.port}: expected 0 to 65535")
        if self.parts is not None and self.parts < 1:
            raise RunError(f"--parts {self.parts}: expected 1 or more")


def lines(options: DemoOptions, folder: Path) -> Iterator[str]:
    """Run the demonstration and yield its output; ends all processes on leaving. Raises ChildError if one fails."""
    start = Start(options.object, 0.0, 0.0, options.seed)
    folder.mkdir(parents=True)
    with Children() as children:
        port = _port(options.port)
        url = f"http://{HOST}:{port}/"
        yield f"page: {url} (from when the service runs, in some seconds)"
        yield "starting the simulated cell"
        cell = children.add(start_cell(start, options, folder, fed=True))
        facts = ready_cell(cell, folder)
        service = children.add(start_service(facts, options, folder, port))
        service.until("service ready at ", SERVICE_READY_S)
        if options.open:
            with contextlib.suppress(webbrowser.Error):
                webbrowser.open(url)
        config = folder / "client.toml"
        token = (folder / "state" / TOKEN_FILE).resolve()
        config.write_text(client_config(facts, url, token, options.link, options.chosen()))
        counted = () if options.parts is None else ("--parts", str(options.parts))
        arguments = ["cycle", "--live", "--config", str(config), "--logs", str(folder / "episodes"), *counted]
        client = children.add(Child("robot client", "robot_client", arguments, folder / "client.log"))
        children.go_first()
        yield from client.lines((cell, service), DAYS_S)
        if client.code not in {0, 1}:
            client.check()
        if client.code == 1:
            yield "the cell holds; the page says why. Ctrl-C ends the demonstration"
            while True:
                cell.check()
                service.check()
                time.sleep(0.5)


def _port(wanted: int) -> int:
    """The requested port, or a free one where that is taken or 0."""
    try:
        with bind_tcp(wanted, "the page") as bound:
            return port_of(bound)
    except BusyPortError:
        return free_port(socket.SOCK_STREAM)
