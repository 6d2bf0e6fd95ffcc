"""How far the compiler of the physics is: the first start on a machine takes a minute or more, and should say so."""

import os
import time
from collections.abc import Callable
from pathlib import Path

from simulation.compile_cache import VARIABLE

KERNELS_N = 57  # files of the compiler; the estimate of the time left rests on it
SAY_EVERY_S = 5.0
QUIET_S = 8.0  # a start that compiles nothing takes less


class Compiling:
    """Counts what the compiler has put into its cache, and tells it every few seconds while it grows."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._folder = Path(os.environ[VARIABLE])
        self._began_n = self._count()
        self._began_s = self._said_s = time.monotonic()

    def look(self) -> None:
        """Called often while the cell starts."""
        now_s = time.monotonic()
        waited_s = now_s - self._began_s
        if waited_s < QUIET_S or now_s - self._said_s < SAY_EVERY_S:
            return
        self._said_s = now_s
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
