"""Versions of the networks under /v1: which decides, which run beside it, and the changes that a person makes."""

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, Query

from service.contract import ContractError
from service.contract.refusals import reason
from service.session.station import Station
from service.versions.versions import State
from service.web.access import Access

Folder = Annotated[str, Query(min_length=1, max_length=4096, pattern=r"^[^\x00]+$")]


def router(station: Station, access: Access) -> APIRouter:
    routes = APIRouter(prefix="/v1/versions", tags=["v1"])
    versions = station.versions
    watch, admin = [access.require("watch")], [access.require("admin")]

    async def done(change: Callable[[], None]) -> State:
        """Files are read and written elsewhere; the answer says what holds from the next insertion on."""
        try:
            await asyncio.to_thread(change)
        except OSError as error:
            raise ContractError(f"versions in {station.settings.state}: {reason(error)}") from None
        return versions.state()

    @routes.get("", dependencies=watch)
    async def state() -> State:
        """The active version, the shadow, the one before, and what speaks for these."""
        return versions.state()

    @routes.post("/shadow", dependencies=admin)
    async def give(folder: Folder) -> State:
        """Let the networks of a folder on the service's machine run in shadow."""
        return await done(lambda: versions.give(Path(folder)))

    @routes.delete("/shadow", dependencies=admin)
    async def drop() -> State:
        """Take the shadow away."""
        return await done(versions.drop)

    @routes.post("/promote", dependencies=admin)
    async def promote() -> State:
        """The shadow decides from the next insertion on."""
        return await done(versions.promote)

    @routes.post("/rollback", dependencies=admin)
    async def roll_back() -> State:
        """The version before decides from the next insertion on."""
        return await done(versions.roll_back)

    return routes
