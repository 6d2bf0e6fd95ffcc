"""What the pages show, made once however many look on: pictures, messages and health, as the JSON that each gets."""

import asyncio
import base64
import contextlib
import json
from collections import deque
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from service.cameras.capture import CameraFrame, now_ns
from service.contract import FINGERS, Finger
from service.decision.controllers import Command
from service.perception.observation import Observation
from service.session.station import Station

PERIOD_S = 0.15
HEALTH_S = 1.0
FRESH_NS = 2_000_000_000  # the last observation is shown so long, then the camera's own picture
MAX_WAITING = 64
_display = ThreadPoolExecutor(1, "display")  # drawing never delays a decision


def picture(frame: CameraFrame, observation: Observation | None) -> dict[str, Any]:
    """What the page draws of one finger: a JPEG, and if it was perceived just now its markers and their residual."""
    if observation is not None and now_ns() - observation.captured_ns < FRESH_NS:
        field, slip = observation.field, observation.slip
        shown = _shown(observation.finger, observation.image, None, slip.state, float(slip.score))
        return shown | {
            "rest": field.rest_px.ravel().round(1).tolist(),
            "moved": field.displacement_px.ravel().round(2).tolist(),
            "residual": slip.residual_px.ravel().round(2).tolist(),
            "valid": field.valid.ravel().tolist(),
            "slipping": slip.slipping.ravel().tolist(),
        }
    shown = _shown(frame.frame.finger, frame.frame.pixels, frame.jpeg, "watching", 0.0)
    return shown | {key: [] for key in ("rest", "moved", "residual", "valid", "slipping")}


def _shown(finger: Finger, pixels: NDArray[np.uint8], jpeg: bytes | None, state: str, score: float) -> dict[str, Any]:
    content = base64.b64encode(jpeg or cv2.imencode(".jpg", pixels)[1].tobytes()).decode()
    height, width = pixels.shape[:2]
    return {"finger": finger, "state": state, "score": score, "width": width, "height": height, "jpeg": content}


def belief_of(command: Command) -> dict[str, Any] | None:
    """The belief before a command, every second cell."""
    belief = command.belief
    if belief is None:
        return None
    return {
        "x_mm": belief.x_mm[::2].tolist(),
        "theta_deg": belief.theta_deg[::2].tolist(),
        "probability": belief.probability[::2, ::2].round(6).tolist(),
        "hit_probability": belief.hit_probability,
    }


def health_of(station: Station) -> dict[str, Any]:
    active = station.active
    return {
        "ready": station.ready,
        "cameras": {f: station.cameras[f].entry.model_dump() for f in FINGERS},
        "driver": active.session.insertion_id if active else None,
        "recording": station.recording_problem,
        "frames_dropped_n": station.counters.frames_dropped_n,
        "insertions_n": station.manager.opened_n,
    }


def _event(kind: str, content: Any) -> str | None:
    """The text of an event that pages show, None for one that they do not."""
    if kind in {"message", "recorded"}:
        return _text(kind, content.model_dump(mode="json"))
    belief = belief_of(content) if kind == "command" else None
    return _text("belief", belief) if belief else None


def _text(kind: str, content: Any) -> str:
    return json.dumps({"kind": kind, "content": content})


@dataclass(slots=True, eq=False)
class Page:
    """What one page has not been sent yet: events in order, and of each picture and the health the newest alone."""

    events: deque[str] = field(default_factory=deque)
    newest: dict[str, str] = field(default_factory=dict)
    _woken: asyncio.Event = field(default_factory=asyncio.Event)

    def add(self, text: str) -> None:
        """An event; a page that lags far behind loses it."""
        if len(self.events) < MAX_WAITING:
            self.events.append(text)
        self._woken.set()

    def show(self, what: str, text: str) -> None:
        self.newest[what] = text
        self._woken.set()

    async def next(self) -> str:
        """The next text to send."""
        while not self.events and not self.newest:
            self._woken.clear()
            await self._woken.wait()
        return self.events.popleft() if self.events else self.newest.pop(next(iter(self.newest)))


class Broadcast:
    """Makes the texts while a page is open. Its methods belong to the event loop."""

    def __init__(self, station: Station) -> None:
        self._station = station
        self._pages: set[Page] = set()
        self._last: dict[str, str] = {}
        self._shown: dict[Finger, int] = {}

    @contextlib.contextmanager
    def page(self) -> Iterator[Page]:
        """A page that is open while the context lasts; the first starts the work, the last ends it."""
        page = Page(newest=dict(self._last))
        self._pages.add(page)
        if len(self._pages) == 1:
            self._start()
        try:
            yield page
        finally:
            self._pages.discard(page)
            if not self._pages:
                self._stop()

    def _start(self) -> None:
        loop = asyncio.get_running_loop()

        def on_event(kind: str, content: Any) -> None:
            if kind in {"message", "recorded", "command"}:
                with contextlib.suppress(RuntimeError):  # the loop is gone: so are the pages
                    loop.call_soon_threadsafe(self._tell, kind, content)

        self._unsubscribe = self._station.hub.subscribe(on_event)
        self._tasks = [loop.create_task(work) for work in (self._show_pictures(), self._show_health())]

    def _stop(self) -> None:
        self._unsubscribe()
        for task in self._tasks:
            task.cancel()
        self._last.clear()
        self._shown.clear()

    def _tell(self, kind: str, content: Any) -> None:
        if text := _event(kind, content):
            for page in self._pages:
                page.add(text)

    def _show(self, what: str, text: str) -> None:
        self._last[what] = text
        for page in self._pages:
            page.show(what, text)

    async def _show_pictures(self) -> None:
        loop, hub = asyncio.get_running_loop(), self._station.hub
        while True:
            for finger in FINGERS:
                frame = hub.frames.get(finger)
                if frame is None or self._shown.get(finger) == frame.frame.captured_ns:
                    continue
                self._shown[finger] = frame.frame.captured_ns
                drawn = loop.run_in_executor(_display, _drawn, frame, hub.observations.get(finger))
                self._show(finger, await drawn)
            await asyncio.sleep(PERIOD_S)

    async def _show_health(self) -> None:
        while True:
            self._show("health", _text("health", health_of(self._station)))
            await asyncio.sleep(HEALTH_S)


def _drawn(frame: CameraFrame, observation: Observation | None) -> str:
    return _text("finger", picture(frame, observation))
