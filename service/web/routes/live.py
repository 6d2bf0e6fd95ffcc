"""The dashboard: its static files, and one WebSocket of events for each page."""

import asyncio
import base64
import contextlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from fastapi import APIRouter, WebSocket
from fastapi.responses import FileResponse
from fastapi.staticfiles import StaticFiles
from numpy.typing import NDArray

from service.cameras.capture import CameraFrame, now_ns
from service.contract import FINGERS, Finger
from service.decision.controllers import Command
from service.perception.observation import Observation
from service.session.station import Station
from service.web.access import Access
from service.web.closing import Ending, close, until_gone, until_one_ends

FOLDER = Path(__file__).parent.parent / "dashboard"
PERIOD_S = 0.15
HEALTH_S = 1.0
FRESH_NS = 2_000_000_000  # the last observation is shown so long, then the camera's own picture
MAX_WAITING = 64
_display = ThreadPoolExecutor(1, "display")  # drawing never delays a decision


def static_files() -> StaticFiles:
    return StaticFiles(directory=FOLDER)


def picture(frame: CameraFrame | None, observation: Observation | None) -> dict[str, Any] | None:
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
    if frame is None:
        return None
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
        "frames_dropped_n": station.counters.frames_dropped_n,
        "insertions_n": station.manager.opened_n,
    }


def router(station: Station, access: Access) -> APIRouter:
    """Routes ``/`` (the page) and ``/v1/live`` (its events)."""
    routes = APIRouter(include_in_schema=False)

    @routes.get("/")
    async def page() -> FileResponse:
        return FileResponse(FOLDER / "index.html")

    @routes.get("/favicon.ico")
    async def icon() -> FileResponse:
        return FileResponse(FOLDER / "icon.svg", media_type="image/svg+xml")

    @routes.websocket("/v1/live")
    async def live(socket: WebSocket) -> None:
        if not await access.admit(socket, "watch"):
            return
        await socket.accept()
        shown = _events(socket, station), _pictures(socket, station), _health(socket, station)
        await close(socket, await until_one_ends(socket, *shown, until_gone(socket)))

    return routes


async def _events(socket: WebSocket, station: Station) -> Ending:
    loop = asyncio.get_running_loop()
    waiting: asyncio.Queue[dict[str, Any]] = asyncio.Queue(MAX_WAITING)

    def put(event: dict[str, Any]) -> None:
        with contextlib.suppress(asyncio.QueueFull):
            waiting.put_nowait(event)

    def on_event(kind: str, content: Any) -> None:
        if kind in {"message", "recorded"}:
            event = {"kind": kind, "content": content.model_dump(mode="json")}
        elif kind == "command" and (belief := belief_of(content)):
            event = {"kind": "belief", "content": belief}
        else:
            return
        with contextlib.suppress(RuntimeError):
            loop.call_soon_threadsafe(put, event)

    remove = station.hub.subscribe(on_event)
    try:
        while True:
            await socket.send_json(await waiting.get())
    finally:
        remove()


async def _pictures(socket: WebSocket, station: Station) -> Ending:
    loop = asyncio.get_running_loop()
    shown: dict[Finger, int] = {}
    while True:
        for finger in FINGERS:
            frame = station.hub.frames.get(finger)
            if frame is None or shown.get(finger) == frame.frame.captured_ns:
                continue
            shown[finger] = frame.frame.captured_ns
            content = await loop.run_in_executor(_display, picture, frame, station.hub.observations.get(finger))
            await socket.send_json({"kind": "finger", "content": content})
        await asyncio.sleep(PERIOD_S)


async def _health(socket: WebSocket, station: Station) -> Ending:
    while True:
        await socket.send_json({"kind": "health", "content": health_of(station)})
        await asyncio.sleep(HEALTH_S)
