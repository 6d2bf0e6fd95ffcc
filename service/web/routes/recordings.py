"""Finished insertions under /v1/recordings: listed, downloaded, played back, removed."""

import shutil
from itertools import islice
from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, HTTPException, Query, Response
from fastapi.responses import FileResponse
from pydantic import BaseModel
from pydantic_core import to_json

from service.contract import wire
from service.recordings.listing import Summary, each_recording
from service.recordings.names import NAME
from service.recordings.writer import FINAL
from service.session.station import Station
from service.web.access import Access
from service.web.reading import Reading

Newest = Annotated[int, Query(ge=1, le=10_000, description="only so many, the newest; all by default")]


class Listed(Summary):
    """A finished insertion with its folder's name and when it began (UTC).

    ``intervals_held_n`` of ``intervals_n`` 90 % intervals held what turned out to be true; ``descended_n`` of its
    ``attempts`` went down.
    """

    name: str
    started: str
    intervals_held_n: int
    intervals_n: int
    descended_n: int


class Recordings(BaseModel):
    """Finished insertions, newest first, and what keeps others from being listed."""

    recordings: list[Listed]
    problems: list[str]


class Mcap(FileResponse):
    """A recording as a file."""

    media_type = "application/octet-stream"


def recording_folder(root: Path, name: str) -> Path:
    """The folder of a recording; 404 unless it is one of ours."""
    folder = root / name
    if not NAME.fullmatch(name) or not (folder / "summary.json").is_file():
        raise HTTPException(404, f"no recording {name}")
    return folder


def recording_file(root: Path, name: str) -> Path:
    """The file of a recording; 404 unless it lies in the recording's own folder, where a link may not lead out of."""
    path = recording_folder(root, name) / FINAL
    if not path.is_file() or path.resolve() != root.resolve() / name / FINAL:
        raise HTTPException(404, f"recording {name} has no {FINAL}")
    return path


def _list(root: Path, insertion_id: str | None, newest: int | None) -> bytes:
    """Recordings as JSON, in steps of one: all at once would keep every other thread waiting meanwhile."""
    problems: list[str] = []
    some = islice(each_recording(root, problems, insertion_id), newest)
    listed = b",".join(to_json(one, inf_nan_mode="null") for one in some)
    return b'{"recordings":[%b],"problems":%b}' % (listed, to_json(problems))


def router(station: Station, access: Access, reading: Reading) -> APIRouter:
    routes = APIRouter(prefix="/v1/recordings", tags=["recordings"])
    watch, admin = [access.require("watch")], [access.require("admin")]
    root = station.settings.recordings

    @routes.get("", dependencies=watch, response_model=Recordings)
    async def recordings(insertion_id: wire.InsertionId | None = None, newest: Newest | None = None) -> Response:
        return Response(await reading(_list, root, insertion_id, newest), media_type="application/json")

    @routes.get("/{name}", dependencies=watch, response_class=Mcap)
    def recording(name: str) -> Mcap:
        return Mcap(recording_file(root, name), filename=f"{name}.mcap")

    @routes.delete("/{name}", dependencies=admin)
    def remove(name: str) -> dict[str, str]:
        folder = recording_folder(root, name)
        try:
            shutil.rmtree(folder)
        except OSError as error:  # read only, or two remove it at once
            raise HTTPException(409, f"recording {name} cannot be removed: {error.strerror}") from None
        return {"removed": name}

    return routes
