"""Child processes of a run: each with its own session and log file, ended in order whatever happens."""

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Self

from simulation.compile_cache import VARIABLE

_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
_TAIL_LINES = 8
KERNELS_N = 57  # cache files that the compiler writes; the estimate of the remaining time is based on it
SAY_EVERY_S = 5.0
QUIET_S = 8.0  # a start that compiles nothing takes less than this


class ChildError(RuntimeError):
    """A child ended or stayed silent unexpectedly; ``code`` is its exit code, None if it was still running."""

    def __init__(self, text: str, code: int | None) -> None:
        super().__init__(text)
        self.code = code


_PRCTL = getattr(ctypes.CDLL(None), "prctl", None)
_PR_SET_PDEATHSIG = 1


def _end_with_parent() -> None:
    """Ask the kernel to end this child when its run dies without ending it: it would play on, with priority."""
    if _PRCTL is not None:
        _PRCTL(_PR_SET_PDEATHSIG, signal.SIGTERM)


class Child:
    """``python -m MODULE ARGUMENTS`` with its output in a log file, in its own session.

    The session keeps the terminal's Ctrl-C away from the child: the run ends its children itself, in order.
    """

    def __init__(self, name: str, module: str, arguments: Sequence[str], log: Path) -> None:
        self.name = name
        self.log = log
        self._asked = False
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("wb") as stream:
            self.process = subprocess.Popen(
                [sys.executable, "-u", "-m", module, *arguments],
                stdout=stream,
                stderr=subprocess.STDOUT,
                stdin=subprocess.DEVNULL,
                env=os.environ | _ONE_THREAD,
                start_new_session=True,
                preexec_fn=_end_with_parent,  # noqa: PLW1509 - one call of the kernel, from the only thread
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    @property
    def code(self) -> int | None:
        """Exit code, None while it runs."""
        return self.process.poll()

    def cpu_s(self) -> float:
        """CPU seconds used so far; nan where the system does not report them or the child has ended."""
        try:
            fields = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
            return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
        except (OSError, IndexError, ValueError):
            return float("nan")

    def go_first(self) -> None:
        """Give it priority over other processes, as on a cell's PC, where the machine allows it."""
        for thread in Path(f"/proc/{self.process.pid}/task").glob("*"):
            with contextlib.suppress(OSError, AttributeError):
                os.sched_setscheduler(int(thread.name), os.SCHED_RR, os.sched_param(1))

    def ask(self) -> None:
        """Ask it once to end, and do not wait: a second signal would interrupt its shutdown."""
        if not self._asked:
            self._asked = True
            self._signal(signal.SIGTERM)

    def end(self, patience_s: float = 8.0) -> None:
        """Ask it to end; kill it after ``patience_s``."""
        self.ask()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(patience_s)
        if self.code is None:
            self._signal(signal.SIGKILL)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(5.0)

    def _signal(self, number: int) -> None:
        if self.code is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.process.pid, number)

    def tail(self) -> str:
        """The last lines of its log, indented."""
        lines = self.log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        return "\n".join(f"  | {line}" for line in lines[-_TAIL_LINES:]) or "  | (no output)"

    def check(self) -> None:
        """Raise ChildError with its last lines if it has ended."""
        if self.code is not None:
            raise ChildError(f"{self.name} ended with exit code {self.code}:\n{self.tail()}", self.code)

    def until(self, text: str, timeout_s: float, while_waiting: Callable[[], None] = lambda: None) -> str:
        """The first line of its log that contains ``text``; raise ChildError if it ends or is late."""
        deadline_s = time.monotonic() + timeout_s
        while time.monotonic() < deadline_s:
            for line in self.log.read_text(encoding="utf-8", errors="replace").splitlines(keepends=True):
                if text in line and line.endswith("\n"):
                    return line.strip()
            self.check()
            while_waiting()
            time.sleep(0.05)
        raise ChildError(f"{self.name} was not ready within {timeout_s:.0f} s:\n{self.tail()}", None)

    def lines(self, others: Sequence["Child"], timeout_s: float) -> Iterator[str]:
        """Yield its output line by line until it ends; raise ChildError if another child ends or time is up."""
        deadline_s = time.monotonic() + timeout_s
        with self.log.open(encoding="utf-8", errors="replace") as stream:
            pending = ""
            while True:
                ended = self.code is not None
                while chunk := stream.readline():
                    pending += chunk
                    if pending.endswith("\n"):
                        yield pending.rstrip()
                        pending = ""
                if ended:
                    return
                for other in others:
                    other.check()
                if time.monotonic() > deadline_s:
                    raise ChildError(f"{self.name} was not done within {timeout_s:.0f} s:\n{self.tail()}", None)
                time.sleep(0.03)


class Children:
    """The processes of a run. On leaving, the last one, which moves the arm, ends first; the others end at once."""

    def __init__(self) -> None:
        self._children: list[Child] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for child in self._children[-1:]:
            child.end()
        for child in self._children:
            child.ask()
        for child in self._children:
            child.end()

    def add(self, child: Child) -> Child:
        """Add a child that ends with the run, and return it."""
        self._children.append(child)
        return child

    def go_first(self) -> None:
        """Call `Child.go_first` on every child."""
        for child in self._children:
            child.go_first()


def terminate_as_interrupt() -> None:
    """Make SIGTERM end the run as Ctrl-C does, so that the children are ended too."""

    def raise_interrupt(_number: int, _frame: object) -> None:
        raise KeyboardInterrupt

    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, raise_interrupt)


class Compiling:
    """Counts the compiler's cache entries, and reports the count every few seconds while it grows."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._folder = Path(os.environ[VARIABLE])
        self._began_n = self._count()
        self._began_s = self._reported_s = time.monotonic()

    def look(self) -> None:
        """Check the cache; call this often while the cell starts."""
        now_s = time.monotonic()
        waited_s = now_s - self._began_s
        if waited_s < QUIET_S or now_s - self._reported_s < SAY_EVERY_S:
            return
        self._reported_s = now_s
        done_n = self._count()
        made_n = done_n - self._began_n
        if not made_n or done_n >= KERNELS_N:
            self._say(f"  still starting, {waited_s:.0f} s")
            return
        left_s = waited_s * (KERNELS_N - done_n) / made_n
        self._say(
            f"  compiling the physics, once on a machine: {100 * done_n // KERNELS_N} %, about {left_s:.0f} s left"
        )

    def _count(self) -> int:
        return sum(1 for _ in self._folder.rglob("*.nbi"))
