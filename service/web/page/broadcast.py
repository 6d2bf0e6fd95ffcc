"""Data for all open pages, made once for all of them: pictures and the state of the cell, as JSON."""

import asyncio
import base64
import contextlib
import json
from collections.abc import Awaitable, Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
import structlog
from numpy.typing import NDArray

from service.cameras.capture import CameraFrame, now_ns
from service.contract import FINGERS, Finger
from service.perception.observation import Observation
from service.perception.rectification import Rectifier
from service.session.station import Station
from service.web.page.status import Status

PERIOD_S = 0.15
STATUS_S = 1.0
FRESH_NS = 2_000_000_000  # how long the last observation is shown after an insertion
_display = ThreadPoolExecutor(1, "display")  # drawing never delays a decision
log = structlog.get_logger()


def picture(frame: CameraFrame, observation: Observation | None, rectifier: Rectifier | None) -> dict[str, Any]:
    """One finger for the page: a JPEG and, if it has just been perceived, its markers, and which of them slip."""
    if observation is not None:
        field, slip = observation.field, observation.slip
        drawn = shown(observation.finger, observation.image, slip.state, float(slip.score))
        return drawn | {
            "rest": field.rest_px.ravel().round(1).tolist(),
            "moved": field.displacement_px.ravel().round(2).tolist(),
            "kinds": kinds(field.valid, slip.slipping, slip.sticking),
            "pitch": field.pitch_px,
        }
    pixels = frame.frame.pixels
    if rectifier is not None and pixels.shape == rectifier.camera.raw.shape:
        pixels = rectifier.apply(pixels)
    drawn = shown(frame.frame.finger, pixels, "watching", 0.0)
    return drawn | {"rest": [], "moved": [], "kinds": [], "pitch": 0.0}


def kinds(valid: NDArray[Any], slipping: NDArray[Any], sticking: NDArray[Any]) -> list[int]:
    """Class of each marker for display, row by row: -1 not visible, 0 outside the contact, 1 sticks, 2 slips."""
    shown = np.where(slipping, 2, np.where(sticking, 1, 0))
    codes: list[int] = np.where(valid, shown, -1).ravel().tolist()
    return codes


def shown(finger: Finger, pixels: NDArray[np.uint8], state: str, score: float) -> dict[str, Any]:
    """A grey JPEG, so that all colours are those of the arrows; it is smaller, too."""
    height, width = pixels.shape[:2]
    jpeg = cv2.imencode(".jpg", cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY), [cv2.IMWRITE_JPEG_QUALITY, 80])[1]
    content = base64.b64encode(jpeg.tobytes()).decode()
    return {"finger": finger, "state": state, "score": score, "width": width, "height": height, "jpeg": content}


def _text(kind: str, content: Any) -> str:
    return json.dumps({"kind": kind, "content": content})


@dataclass(slots=True, eq=False)
class Page:
    """Data not yet sent to one page: only the newest state and the newest of each picture."""

    newest: dict[str, str] = field(default_factory=dict)
    _woken: asyncio.Event = field(default_factory=asyncio.Event)

    def show(self, what: str, text: str) -> None:
        self.newest[what] = text
        self._woken.set()

    async def next(self) -> str:
        while not self.newest:
            self._woken.clear()
            await self._woken.wait()
        return self.newest.pop(next(iter(self.newest)))


class Broadcast:
    """Builds the texts while a page is open. Its methods belong to the event loop."""

    def __init__(self, station: Station, status: Status) -> None:
        self._station, self._status = station, status
        self._pages: set[Page] = set()
        self._last: dict[str, str] = {}
        self._shown: dict[Finger, int] = {}
        calibration = station.manager.calibration
        self._rectifiers = {f: Rectifier(calibration.camera(f)) for f in FINGERS} if calibration else {}

    @contextlib.contextmanager
    def page(self) -> Iterator[Page]:
        """A page that is open for the duration of the context; the first one starts the work, the last one ends it."""
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
        self._tasks = [loop.create_task(_kept_up(show)) for show in (self._show_pictures, self._show_status)]

    def _stop(self) -> None:
        for task in self._tasks:
            task.cancel()
        self._last.clear()
        self._shown.clear()

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
                given = frame, self._felt(finger), self._rectifiers.get(finger)
                self._show(finger, await loop.run_in_executor(_display, _drawn, *given))
            await asyncio.sleep(PERIOD_S)

    def _felt(self, finger: Finger) -> Observation | None:
        """The last observation, while its insertion runs; between attempts nothing is judged and it stays valid."""
        felt, active = self._station.hub.observations.get(finger), self._station.active
        if felt is None or (active is not None and felt.captured_ns > active.opened_ns):
            return felt
        return felt if now_ns() - felt.captured_ns < FRESH_NS else None

    async def _show_status(self) -> None:
        """Show the state after each change, and otherwise as often as its figures require."""
        shown_n, shown_s = -1, 0.0
        while True:
            changes_n, now_s = self._status.changes_n, asyncio.get_running_loop().time()
            if changes_n != shown_n or now_s - shown_s >= STATUS_S:
                shown_n, shown_s = changes_n, now_s
                self._show("status", _text("status", await asyncio.to_thread(self._status.snapshot)))
            await asyncio.sleep(PERIOD_S)


async def _kept_up(show: Callable[[], Awaitable[None]]) -> None:
    """Show on after a failure: else every page would keep what it shows, and look as if nothing happened."""
    while True:
        try:
            await show()
        except Exception as error:
            log.error("page", error=repr(error))  # noqa: TRY400 - one line, not a page, each second
        await asyncio.sleep(STATUS_S)


def _drawn(frame: CameraFrame, observation: Observation | None, rectifier: Rectifier | None) -> str:
    return _text("finger", picture(frame, observation, rectifier))
