"""The thread the networks run in, so that slip detection never waits for a network."""

import queue
import threading
from collections.abc import Callable

from service.decision.attempt import WorkResult
from service.decision.work import Work


class ModelsWorker:
    """Runs network work in order, one piece at a time; results go to ``on_result`` in this thread."""

    def __init__(self, on_result: Callable[[WorkResult], None]) -> None:
        self._on_result = on_result
        self._queue: queue.SimpleQueue[Work | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="networks", daemon=True)
        self._thread.start()

    def submit(self, work: Work) -> None:
        """Queue one piece of work."""
        self._queue.put(work)

    def stop(self) -> None:
        """End the thread after the work that waits; at most 5 s."""
        self._queue.put(None)
        self._thread.join(5.0)

    def _run(self) -> None:
        while (work := self._queue.get()) is not None:
            result = work.run()
            if result is not None:
                self._on_result(result)
