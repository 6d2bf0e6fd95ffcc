"""The service's own HTTP interface: /v1."""

import asyncio
import contextlib
import json
import shutil
from collections.abc import AsyncIterator
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from fastapi import APIRouter, HTTPException, Query, Request, WebSocket, WebSocketDisconnect
from fastapi.responses import FileResponse, Response, StreamingResponse

from service.contract import FINGERS, ContractError, Finger, decode_frame
from service.decision import DecisionRun
from service.recording import FINAL
from service.routes.access import Access
from service.station import Station

BOUNDARY = "frame"
STREAM_PERIOD_S = 0.1
MAX_BODY_BYTES = 64 << 20


def list_recordings(root: Path) -> list[dict[str, Any]]:
    """Finished insertions, newest first."""
    found = []
    for folder in sorted((p for p in root.iterdir() if (p / "summary.json").is_file()), reverse=True):
        summary = json.loads((folder / "summary.json").read_text())
        stamp = datetime.strptime(folder.name.split("_")[0][:15], "%Y%m%dT%H%M%S")  # noqa: DTZ007 - shown as it is, UTC
        decided = sorted(int(p.stem[-2:]) for p in folder.glob("attempt_*.npz"))
        facts = {"name": folder.name, "started": f"{stamp:%Y-%m-%d %H:%M:%S}", "decided": decided}
        found.append(facts | summary)
    return found


def recording_folder(root: Path, name: str) -> Path:
    """The folder of a recording; 404 unless it is one of ours."""
    folder = root / name
    if "/" in name or name.startswith(".") or not (folder / "summary.json").is_file():
        raise HTTPException(404, f"no recording {name}")
    return folder


def _attempt(folder: Path, number: int) -> Any:
    path = folder / f"attempt_{number:02d}.npz"
    if not path.is_file():
        raise HTTPException(404, f"recording {folder.name} has no decided attempt {number}")
    return np.load(path)


def frame_jpeg(folder: Path, number: int, index: int) -> bytes:
    """Both fingers side by side, one frame of a decision."""
    with _attempt(folder, number) as arrays:
        frames = arrays["frames"]
    if not 0 <= index < len(frames):
        raise HTTPException(404, f"attempt {number} has frames 0..{len(frames) - 1}")
    return bytes(cv2.imencode(".jpg", np.hstack(list(frames[index])))[1].tobytes())


def attempt_facts(folder: Path, number: int) -> dict[str, Any]:
    """An attempt's decision and how many frames it rests on."""
    with _attempt(folder, number) as arrays:
        return {"frames_n": len(arrays["frames"]), "decision": json.loads(str(arrays["decision"]))}


def decide(
    station: Station, frames: np.ndarray[Any, np.dtype[np.uint8]], gap_width_mm: float, grasp_height_mm: float | None
) -> dict[str, Any]:
    """What the networks say of a recorded sequence uint8 [n, 2, H, W, 3]; the first pair is the reference."""
    run = DecisionRun(station.models, frames[0], gap_width_mm, grasp_height_mm)
    for frame in frames[: station.models.card.frames_per_decision]:
        run.step(frame)
    evidence = run.evidence()
    return {
        "class_probabilities": evidence.class_probabilities(),
        "estimate": evidence.estimate().model_dump(),
        "confidence": evidence.confidence,
    }


def router(station: Station, access: Access) -> APIRouter:  # noqa: C901 - one table of routes
    """Routes under ``/v1``."""
    routes = APIRouter(prefix="/v1", tags=["v1"])
    watch, drive, admin = ([access.require(role)] for role in ("watch", "drive", "admin"))
    root = station.settings.recordings

    @routes.get("/models", dependencies=watch)
    async def models() -> dict[str, Any]:
        return {"models": [entry.model_dump(mode="json") for entry in station.models.entries]}

    @routes.get("/cameras", dependencies=watch)
    async def cameras() -> dict[str, Any]:
        return {"cameras": [entry.model_dump(mode="json") for entry in station.camera_entries()]}

    @routes.get("/insertions", dependencies=watch)
    async def insertions() -> dict[str, Any]:
        active = station.active
        return {"active": active.session.insertion_id if active else None, "count": station.desk.opened_n}

    @routes.get("/recordings", dependencies=watch)
    async def recordings() -> dict[str, Any]:
        return {"recordings": await asyncio.to_thread(list_recordings, root)}

    @routes.get("/recordings/{name}", dependencies=watch)
    async def recording(name: str) -> FileResponse:
        return FileResponse(recording_folder(root, name) / FINAL, filename=f"{name}.mcap")

    @routes.delete("/recordings/{name}", dependencies=admin)
    async def remove(name: str) -> dict[str, str]:
        await asyncio.to_thread(shutil.rmtree, recording_folder(root, name))
        return {"removed": name}

    @routes.get("/recordings/{name}/attempts/{number}", dependencies=watch)
    async def attempt(name: str, number: int) -> dict[str, Any]:
        return await asyncio.to_thread(attempt_facts, recording_folder(root, name), number)

    @routes.get("/recordings/{name}/attempts/{number}/frames/{index}.jpg", dependencies=watch)
    async def frame(name: str, number: int, index: int) -> Response:
        content = await asyncio.to_thread(frame_jpeg, recording_folder(root, name), number, index)
        return Response(content, media_type="image/jpeg")

    @routes.get("/cameras/{finger}/stream.mjpg", dependencies=watch)
    async def stream(finger: Finger) -> StreamingResponse:
        return StreamingResponse(_parts(station, finger), media_type=f"multipart/x-mixed-replace; boundary={BOUNDARY}")

    @routes.post("/decisions", dependencies=drive)
    async def decisions(
        request: Request,
        gap_width_mm: Annotated[float, Query(gt=0, le=1000)] = 56.0,
        grasp_height_mm: Annotated[float | None, Query(gt=0, le=500)] = None,
    ) -> dict[str, Any]:
        """Body: encoded frames one after the other (left, right, left, right, ...), rectified."""
        body = await _body(request)
        frames = _pairs(body, station)
        return await asyncio.to_thread(decide, station, frames, gap_width_mm, grasp_height_mm)

    @routes.websocket("/cameras/{finger}/push")
    async def push(socket: WebSocket, finger: Finger) -> None:
        if not await access.admit(socket, "drive"):
            return
        await socket.accept()
        with contextlib.suppress(WebSocketDisconnect):
            try:
                source = station.push(finger)
                while True:
                    source.push(decode_frame(await socket.receive_bytes()))
            except (ContractError, KeyError) as error:
                await socket.close(1003, str(error)[:120])

    return routes


async def _parts(station: Station, finger: Finger) -> AsyncIterator[bytes]:
    shown = -1
    station.viewers_n += 1
    try:
        while True:
            frame = station.hub.frames.get(finger)
            if frame is not None and frame.frame.captured_ns != shown:
                shown = frame.frame.captured_ns
                jpeg = frame.jpeg
                if jpeg is None:
                    jpeg = await asyncio.to_thread(_encode, frame.frame.pixels)
                head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
                yield head.encode() + jpeg + b"\r\n"
            await asyncio.sleep(STREAM_PERIOD_S)
    finally:
        station.viewers_n -= 1


def _encode(pixels: Any) -> bytes:
    return bytes(cv2.imencode(".jpg", pixels)[1].tobytes())


async def _body(request: Request) -> bytes:
    body = bytearray()
    async for chunk in request.stream():
        body += chunk
        if len(body) > MAX_BODY_BYTES:
            raise HTTPException(413, f"body larger than {MAX_BODY_BYTES} bytes")
    return bytes(body)


def _pairs(body: bytes, station: Station) -> np.ndarray[Any, np.dtype[np.uint8]]:
    card = station.models.card
    height, width, channels = card.frame.shape
    needed = 2 * card.frames_per_decision
    size, rest = divmod(len(body), needed)
    if rest or not size:
        raise ContractError(f"body of {len(body)} bytes, expected {needed} encoded frames of {width} x {height}")
    frames = [decode_frame(body[i * size : (i + 1) * size], card.frame) for i in range(needed)]
    if [frame.finger for frame in frames] != list(FINGERS) * card.frames_per_decision:
        raise ContractError("frames must alternate left, right")
    return np.stack([frame.pixels for frame in frames]).reshape(-1, 2, height, width, channels)
