"""What keeps insertions from being recorded, as far as their disk answers: one that hangs keeps no page waiting."""

import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

ANSWER_S = 2.0  # for which a state waits; a page without one for 5 s has no connection
SILENT_S = 10.0
SILENT = "the disk of the recordings has not answered"
_disk = ThreadPoolExecutor(1, "disk")


class Disk:
    """The disk of the recordings, which ``ask`` asks for what is wrong. Thread safe."""

    def __init__(self, ask: Callable[[], str]) -> None:
        self._ask, self._answer = ask, ""
        self._asked: tuple[Future[str], float] | None = None

    def problem(self) -> str:
        """What is wrong now, "" for nothing; of a slow disk what it answered last."""
        asked = self._asked
        if asked is None or asked[0].done():
            asked = self._asked = _disk.submit(self._ask), time.monotonic()
        waited_s = time.monotonic() - asked[1]
        try:
            self._answer = asked[0].result(max(0.0, ANSWER_S - waited_s))
        except TimeoutError:
            if waited_s > SILENT_S:
                self._answer = f"{SILENT} for {SILENT_S:g} s"
        return self._answer
