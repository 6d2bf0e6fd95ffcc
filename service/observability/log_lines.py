"""A separate thread writes log lines, so that logging cannot delay or end an insertion.

Standard error is often a pipe. Its reader may stall (writes block), leave (writes raise), or have a full disk.
"""

import queue
import threading
from collections.abc import Callable
from typing import TextIO

MAX_WAITING = 4096  # lines; beyond it new ones are lost, and counted


class LogLines:
    """A stream for loggers: ``write`` takes whole lines, returns at once and never raises. Thread safe.

    ``stream`` is called for each line, as the process's standard error may be replaced while it runs.
    """

    def __init__(self, stream: Callable[[], TextIO]) -> None:
        self.lost_n = 0
        self._stream = stream
        self._reported_n = 0
        self._lock = threading.Lock()
        self._lines: queue.Queue[str | None] = queue.Queue(MAX_WAITING)
        self._thread = threading.Thread(target=self._run, name="log", daemon=True)
        self._thread.start()

    def write(self, line: str) -> None:
        try:
            self._lines.put_nowait(line)
        except queue.Full:
            self._lose()

    def flush(self) -> None:
        """Nothing to do: lines are flushed as they are written."""

    def close(self, timeout_s: float = 2.0) -> None:
        """Write the pending lines, for at most ``timeout_s``, and end the thread."""
        try:
            self._lines.put(None, timeout=timeout_s)
        except queue.Full:
            return
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while (line := self._lines.get()) is not None:
            lost_n = self.lost_n
            if lost_n > self._reported_n and self._put(f"{lost_n} log lines were lost\n"):
                self._reported_n = lost_n
            if not self._put(line):
                self._lose()

    def _lose(self) -> None:
        with self._lock:
            self.lost_n += 1

    def _put(self, line: str) -> bool:
        try:
            stream = self._stream()
            stream.write(line)
            stream.flush()
        except (OSError, ValueError, AttributeError):  # gone, closed, or never there
            return False
        return True
