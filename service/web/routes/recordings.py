"""Finished insertions under /v1/recordings: listed, downloaded, played back, removed."""

import asyncio
import json
import shutil
import zipfile
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from fastapi import APIRouter, HTTPException
from fastapi import Path as InPath
from fastapi.responses import FileResponse, Response
from numpy.typing import NDArray
from pydantic import BaseModel

from service.contract.wire import MAX_ATTEMPTS
from service.recordings.listing import Summary, list_recordings
from service.recordings.writer import FINAL, NAME
from service.session.station import Station
from service.web.access import Access

Number = Annotated[int, InPath(ge=1, le=MAX_ATTEMPTS)]
Index = Annotated[int, InPath(ge=0, le=999)]


class JPEG(Response):
    media_type = "image/jpeg"


class Listed(Summary):
    """A finished insertion with its folder's name, when it began (UTC), and which attempts were decided.

    ``intervals_held_n`` of ``intervals_n`` 90 % intervals held what turned out to be true.
    """

    name: str
    started: str
    decided: list[int]
    intervals_held_n: int
    intervals_n: int


class Recordings(BaseModel):
    """Finished insertions, newest first, and what keeps others from being listed."""

    recordings: list[Listed]
    problems: list[str]


class Attempt(BaseModel):
    """A decided attempt: how many frame pairs it rests on, and the `correction` or `no_decision` that was sent."""

    frames_n: int
    decision: dict[str, Any]


def recording_folder(root: Path, name: str) -> Path:
    """The folder of a recording; 404 unless it is one of ours."""
    folder = root / name
    if not NAME.fullmatch(name) or not (folder / "summary.json").is_file():
        raise HTTPException(404, f"no recording {name}")
    return folder


def _attempt(folder: Path, number: int) -> tuple[NDArray[np.uint8], dict[str, Any]]:
    """Frames uint8 [n, 2, H, W, 3] and decision of an attempt; 404 where there is none that can be read."""
    try:
        with np.load(folder / f"attempt_{number:02d}.npz") as arrays:
            return arrays["frames"], json.loads(str(arrays["decision"]))
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        raise HTTPException(404, f"recording {folder.name} has no decided attempt {number}") from None


def frame_jpeg(folder: Path, number: int, index: int) -> bytes:
    """Both fingers side by side, one frame of a decision."""
    frames, _ = _attempt(folder, number)
    if not 0 <= index < len(frames):
        raise HTTPException(404, f"attempt {number} has frames 0..{len(frames) - 1}")
    return bytes(cv2.imencode(".jpg", np.hstack(list(frames[index])))[1].tobytes())


def attempt_facts(folder: Path, number: int) -> dict[str, Any]:
    """An attempt's decision and how many frames it rests on."""
    frames, decision = _attempt(folder, number)
    return {"frames_n": len(frames), "decision": decision}


def router(station: Station, access: Access) -> APIRouter:
    routes = APIRouter(prefix="/v1/recordings", tags=["recordings"])
    watch, admin = [access.require("watch")], [access.require("admin")]
    root = station.settings.recordings

    @routes.get("", dependencies=watch, response_model=Recordings)
    async def recordings() -> dict[str, Any]:
        listed, problems = await asyncio.to_thread(list_recordings, root)
        return {"recordings": listed, "problems": problems}

    @routes.get("/{name}", dependencies=watch, response_class=FileResponse)
    async def recording(name: str) -> FileResponse:
        path = recording_folder(root, name) / FINAL
        if not path.is_file():
            raise HTTPException(404, f"recording {name} has no {FINAL}")
        return FileResponse(path, filename=f"{name}.mcap", media_type="application/octet-stream")

    @routes.delete("/{name}", dependencies=admin)
    async def remove(name: str) -> dict[str, str]:
        await asyncio.to_thread(shutil.rmtree, recording_folder(root, name))
        return {"removed": name}

    @routes.get("/{name}/attempts/{number}", dependencies=watch, response_model=Attempt)
    async def attempt(name: str, number: Number) -> dict[str, Any]:
        return await asyncio.to_thread(attempt_facts, recording_folder(root, name), number)

    @routes.get("/{name}/attempts/{number}/frames/{index}.jpg", dependencies=watch, response_class=JPEG)
    async def frame(name: str, number: Number, index: Index) -> Response:
        return JPEG(await asyncio.to_thread(frame_jpeg, recording_folder(root, name), number, index))

    return routes
