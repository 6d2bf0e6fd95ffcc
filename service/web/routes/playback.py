"""Looking at a finished insertion under /v1/recordings: its curves, its moments, and whether it is decided the same."""

import asyncio
import contextlib
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, HTTPException, Query

from service.contract import Finger
from service.recordings.need import needed
from service.session.station import Station
from service.web.access import Access
from service.web.page.playback import moment, timeline
from service.web.reading import Reading
from service.web.routes.recordings import recording_file

AGAIN_S = 120.0
LOOK_S = 0.1
POLITELY = 10  # less of the processor than the service
MOST_AGAIN_BYTES = 320_000_000  # beside the service, within the memory that its unit is given


def router(station: Station, access: Access, reading: Reading) -> APIRouter:
    routes = APIRouter(prefix="/v1/recordings/{name}", tags=["recordings"], dependencies=[access.require("watch")])
    deciding = asyncio.Lock()

    def file_of(name: str) -> Path:
        return recording_file(station.settings.recordings, name)

    @routes.get("/timeline")
    async def curves(name: str, earlier_n: Annotated[int, Query(ge=0)] = 0) -> dict[str, Any]:
        """Slip, push and depth over time, what happened, and the moments that can be looked at.

        Attempts are counted on from ``earlier_n``.
        """
        return await reading(lambda: timeline(file_of(name), earlier_n))

    @routes.get("/moments/{finger}/{at_ns}")
    async def felt(name: str, finger: Finger, at_ns: int) -> dict[str, Any]:
        """What a finger felt at a moment: its picture, its markers, which of them slip."""
        return await reading(lambda: moment(file_of(name), finger, at_ns))

    @routes.post("/decide", responses={504: {"description": f"not decided within {AGAIN_S:g} s"}})
    async def decide_again(name: str) -> dict[str, Any]:
        """Decide the whole insertion again, in a process of its own, with the networks that decided it.

        They must be loaded: active, beside, or released; otherwise ``same`` is null and the answer names them. 422 if
        the recording fills more than 320 MB.
        """
        if station.active is not None or deciding.locked():
            raise HTTPException(409, "busy: an insertion is under way, or another one is being decided again")
        async with deciding:
            path = await asyncio.to_thread(file_of, name)  # a share may take seconds to answer
            need = await asyncio.to_thread(needed, path)
            if need.bytes_n > MOST_AGAIN_BYTES:
                raise HTTPException(422, _too_large(need.bytes_n))
            models = station.versions.with_hashes(need.networks)
            return await _replayed(path, models.steps[0].path.parent, lambda: station.active is not None)

    return routes


async def _replayed(path: Path, models: Path, busy: Callable[[], bool]) -> dict[str, Any]:
    """What `service replay` says of a recording; ``same`` None where it could not be decided again.

    It ends as soon as the service is ``busy``: an insertion needs the processor.
    """
    command = (sys.executable, "-m", "service", "replay", str(path), "--models", str(models))
    pipe = asyncio.subprocess.PIPE
    process = await asyncio.create_subprocess_exec(*command, stdout=pipe, stderr=asyncio.subprocess.STDOUT)
    with contextlib.suppress(ProcessLookupError):  # from here: to do it there, all threads would wait for a whole fork
        os.setpriority(os.PRIO_PROCESS, process.pid, os.getpriority(os.PRIO_PROCESS, 0) + POLITELY)
    output = asyncio.create_task(process.communicate())
    try:
        async with asyncio.timeout(AGAIN_S):
            while not output.done():
                if busy():
                    raise HTTPException(409, "busy: an insertion has begun")
                await asyncio.wait([output], timeout=LOOK_S)
    except TimeoutError:
        raise HTTPException(504, f"not decided again within {AGAIN_S:g} s") from None
    finally:
        if process.returncode is None:
            process.kill()
    lines, _ = await output
    same = {0: True, 1: False}.get(process.returncode if process.returncode is not None else -1)
    return {"same": same, "lines": lines.decode(errors="replace").splitlines()[-20:]}


def _too_large(bytes_n: int) -> str:
    sizes = f"fills {bytes_n / 1e6:.0f} MB, and at most {MOST_AGAIN_BYTES / 1e6:.0f} MB are taken from this machine"
    return f"the recording {sizes}: download it and use `tactile-insertion replay` on another one"
