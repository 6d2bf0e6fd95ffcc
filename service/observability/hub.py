"""Current events for metrics, the dashboard and watching clients."""

import threading
from collections.abc import Callable
from typing import Any

import structlog

from service.cameras.capture import CameraFrame
from service.contract import Finger
from service.perception.observation import Observation

Listener = Callable[[str, Any], None]
log = structlog.get_logger()


class Hub:
    """Passes events to listeners and keeps the newest frame and observation of each finger. Thread safe.

    Listeners are called in the publishing thread and must return at once (they hand over to their own loop). A listener
    that raises is logged and counted: it cannot break an insertion.
    """

    def __init__(self) -> None:
        self.frames: dict[Finger, CameraFrame] = {}
        self.observations: dict[Finger, Observation] = {}
        self.errors_n = 0
        self._listeners: tuple[Listener, ...] = ()
        self._lock = threading.Lock()

    def subscribe(self, listener: Listener) -> Callable[[], None]:
        """Add a listener; returns a function that removes it."""
        with self._lock:
            self._listeners = (*self._listeners, listener)

        def remove() -> None:
            with self._lock:
                self._listeners = tuple(other for other in self._listeners if other is not listener)

        return remove

    def publish(self, kind: str, content: Any) -> None:
        for listener in self._listeners:
            try:
                listener(kind, content)
            except Exception as error:
                self.errors_n += 1
                log.error("listener", event_kind=kind, error=repr(error))  # noqa: TRY400 - one line, not a page, a frame

    def frame(self, frame: CameraFrame) -> None:
        self.frames[frame.frame.finger] = frame
        self.publish("frame", frame)

    def observation(self, observation: Observation) -> None:
        self.observations[observation.finger] = observation
        self.publish("observation", observation)
