"""The dashboard: its static files, and one WebSocket of events for each page."""

from pathlib import Path

from fastapi import APIRouter, WebSocket
from fastapi.responses import FileResponse

from service.session.station import Station
from service.web.access import Access
from service.web.closing import Ending, Slots, close, until_gone, until_one_ends
from service.web.page.broadcast import Broadcast, Page
from service.web.page.status import Status

FOLDER = Path(__file__).parent.parent / "dashboard"
MAX_PAGES = 24


def router(station: Station, access: Access, status: Status) -> APIRouter:
    """Routes ``/`` (the page) and ``/v1/live`` (its events)."""
    routes = APIRouter(include_in_schema=False)
    broadcast, slots = Broadcast(station, status), Slots(MAX_PAGES)

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
        async with slots.taken(socket) as admitted:
            if admitted:
                with broadcast.page() as shown:
                    await close(socket, await until_one_ends(socket, _send(socket, shown), until_gone(socket)))

    return routes


async def _send(socket: WebSocket, page: Page) -> Ending:
    while True:
        await socket.send_text(await page.next())
