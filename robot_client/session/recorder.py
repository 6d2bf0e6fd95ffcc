"""The episode log: one JSON object per line, every event and every command in order; enough to replay the insertion.

First line: the plan, with the client's release and the time (UTC). Then ``{"event": ...}`` and ``{"command": ...}`` as
they happened; last ``{"end": ...}``.
A thread of its own writes them: the event loop that guides the arm waits for no disk.
"""

import contextlib
import json
import time
from collections.abc import Iterator
from pathlib import Path
from queue import SimpleQueue
from tempfile import TemporaryFile
from threading import Thread
from typing import IO, Any

from pydantic import ValidationError

from robot_client.insertion.events import COMMAND, EVENT, Command, Event
from robot_client.insertion.state import Plan
from service import __version__
from service.contract.frames import ContractError, first_error
from service.contract.refusals import reason

LOG_VERSION = 2
LAST_LINES_S = 5.0  # a disk that has not taken the rest by then keeps nobody waiting any longer


def check_takes_files(folder: Path) -> None:
    """Make the folder and a file in it; raises ContractError now, rather than with a part in the hand."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        TemporaryFile(dir=folder).close()
    except OSError as error:
        raise ContractError(f"cannot write files into {folder}: {error.strerror}") from None


class Recorder:
    """Writes one episode; each line is flushed.

    A log that cannot be created raises ContractError. A log that cannot be continued (a full disk, one that does not
    answer) ends there, and ``lost`` holds the reason after :meth:`end`.
    """

    def __init__(self, path: Path | None, plan: Plan) -> None:
        self.path = path
        self.lost = ""
        self._file: IO[str] | None = None
        self._lines: SimpleQueue[dict[str, Any] | None] = SimpleQueue()  # None: the last one
        self._writer: Thread | None = None
        if path is not None:
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                self._file = path.open("x", encoding="utf-8", buffering=1)
            except OSError as error:
                raise ContractError(f"cannot write the episode log {path}: {error.strerror}") from None
            self._writer = Thread(target=self._write_all, name="episode log", daemon=True)  # no process waits for it
            self._writer.start()
        begun = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
        known = {"version": LOG_VERSION, "release": __version__, "begun": begun}
        self._put({**known, "plan": plan.model_dump(mode="json")})

    def event(self, event: Event) -> None:
        self._put({"event": event.model_dump(mode="json")})

    def command(self, command: Command) -> None:
        self._put({"command": command.model_dump(mode="json")})

    def end(self, summary: dict[str, Any]) -> None:
        """Write the last line and close, waiting for LAST_LINES_S at most; only once nothing moves any more."""
        self._put({"end": summary})
        if self._writer is None:
            return
        writer, self._writer = self._writer, None
        self._lines.put(None)
        writer.join(LAST_LINES_S)
        if writer.is_alive():
            self.lost = f"the disk has not taken its last lines within {LAST_LINES_S:g} s"

    def _put(self, line: dict[str, Any]) -> None:
        if self._writer is not None:
            self._lines.put(line)

    def _write_all(self) -> None:
        while (line := self._lines.get()) is not None:
            self._write(line)
        self._close()

    def _write(self, line: dict[str, Any]) -> None:
        if self._file is None:
            return
        try:
            self._file.write(json.dumps(line, allow_nan=False) + "\n")
        except (OSError, ValueError, TypeError) as error:  # the latter two: of figures that a driver made up
            self.lost = reason(error)
            self._close()

    def _close(self) -> None:
        if self._file is not None:
            with contextlib.suppress(OSError):  # closing tries to write the rest again
                self._file.close()
            self._file = None


def read_log(path: Path) -> tuple[Plan, list[Event | Command], dict[str, Any]]:
    """Plan, events and commands in order, and the end (empty if the episode was truncated); raises ContractError."""
    entries: list[Event | Command] = []
    plan: Plan | None = None
    end: dict[str, Any] = {}
    for number, line in _lines(path):
        try:
            if "plan" in line:
                _check_version(path, line)
                plan = Plan.model_validate_json(json.dumps(line["plan"]))
            elif "event" in line:
                entries.append(EVENT.validate_python(line["event"], strict=False))
            elif "command" in line:
                entries.append(COMMAND.validate_python(line["command"], strict=False))
            elif isinstance(line.get("end", {}), dict):
                end = line.get("end", end)
            else:
                raise ContractError(f"{path}, line {number}: end: expected a JSON object")
        except ValidationError as error:
            raise ContractError(f"{path}, line {number}: {first_error(error)}") from None
    if plan is None:
        raise ContractError(f"{path} has no plan in its first line; is it an episode log?")
    return plan, entries, end


def _check_version(path: Path, line: dict[str, Any]) -> None:
    version = line.get("version")
    if version != LOG_VERSION:
        release = f"release {line['release']}, which" if "release" in line else "the release that"
        which = f"{path} is an episode log of version {version!r}, expected {LOG_VERSION}"
        raise ContractError(f"{which}: replay it with {release} wrote it")


def _lines(path: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ContractError(f"cannot read episode log {path}: {error}") from None
    lines = text.splitlines()
    for number, line in enumerate(lines, 1):
        try:
            data = json.loads(line)
        except json.JSONDecodeError as error:
            if number == len(lines):
                return  # the client died while writing this line; the earlier ones still count
            raise ContractError(f"{path}, line {number}: {error.msg}") from None
        except RecursionError:
            raise ContractError(f"{path}, line {number}: nested too deeply for an episode log") from None
        if not isinstance(data, dict):
            raise ContractError(f"{path}, line {number}: expected a JSON object")
        yield number, data
