"""Subscription Service (ABB's reference, 3HAC050973-001 rev M): a resource list becomes a WebSocket that sends changes.

As on the controller, subscriptions are slow: states are compared every 0.2 s. EGM and polling are faster.
"""

import asyncio
import itertools
from collections.abc import Callable
from typing import NamedTuple

from fastapi import FastAPI, Request, Response, WebSocket, WebSocketDisconnect

from simulation.cell.emulators.abb.cabinet import Cabinet
from simulation.cell.emulators.abb.rws_more import fields

PROTOCOL = "robapi2_subscription"
_PERIOD_S = 0.2
_MAX_SUBSCRIPTIONS = 64


class Watched(NamedTuple):
    """One subscribed resource: the event's class, the field it carries, and its present value."""

    path: str
    event: str
    field: str
    read: Callable[[], str]

    def message(self, value: str) -> str:
        href = f"/rw/elog/0/{value}" if self.event == "elog-message-ev" else self.path
        return (
            f'<li class="{self.event}" title="{self.field}"><a href="{href}" rel="self"/>'
            f'<span class="{self.field}">{value}</span></li>'
        )


def watched(cabinet: Cabinet, path: str) -> Watched:
    """The resource that a subscription names; raise KeyError for one that cannot be subscribed."""
    name = path.split(";", maxsplit=1)[0].rsplit("/", 1)[-1]
    if path == "/rw/panel/ctrlstate":
        return Watched(path, "pnl-ctrlstate-ev", "ctrlstate", lambda: cabinet.state)
    if path == "/rw/panel/opmode":
        return Watched(path, "pnl-opmode-ev", "opmode", lambda: cabinet.board.faults.robot.mode)
    if path == "/rw/rapid/execution;ctrlexecstate":
        state = {True: "running", False: "stopped"}
        return Watched(path, "rap-ctrlexecstate-ev", "ctrlexecstate", lambda: state[cabinet.running])
    if path == "/rw/elog/0":
        return Watched(path, "elog-message-ev", "seqnum", lambda: str(cabinet.log[-1].number) if cabinet.log else "0")
    if path.startswith("/rw/iosystem/signals/") and name in cabinet.signals:
        return Watched(path, "ios-signalstate-ev", "lvalue", lambda: f"{cabinet.signals[name]:g}")
    if path.startswith("/rw/rapid/symbol/data/RAPID/") and name in cabinet.symbols:
        return Watched(path, "rap-data", "value", lambda: cabinet.symbols[name])
    raise KeyError(path)


class Subscriptions:
    """The open subscriptions of one controller."""

    def __init__(self, cabinet: Cabinet) -> None:
        self._cabinet = cabinet
        self._numbers = itertools.count(1)
        self._open: dict[int, list[Watched]] = {}

    def create(self, form: list[tuple[str, str]]) -> int:
        """Open one for a form's resources (``resources=1&1=PATH&1-p=PRIORITY``); raise KeyError or ValueError."""
        named = dict(form)
        wanted = [named[number] for key, number in form if key == "resources" and number in named]
        if not wanted:
            raise ValueError("a subscription names its resources: resources=1&1=/rw/panel/ctrlstate&1-p=1")
        if len(self._open) >= _MAX_SUBSCRIPTIONS:
            raise ValueError(f"more than {_MAX_SUBSCRIPTIONS} subscriptions")
        number = next(self._numbers)
        self._open[number] = [watched(self._cabinet, path) for path in wanted]
        return number

    async def serve(self, socket: WebSocket, number: int) -> None:
        """Send every change of a subscription until the client leaves."""
        resources = self._open.get(number)
        if resources is None:
            await socket.close(1008)
            return
        await socket.accept(subprotocol=PROTOCOL)
        leaving = asyncio.create_task(socket.receive())
        try:
            await self._notify(socket, resources, leaving)
        except WebSocketDisconnect:
            pass
        finally:
            leaving.cancel()
            self._open.pop(number, None)

    def end(self, number: int, path: str = "") -> None:
        """Forget a subscription, or one resource of it; raise KeyError if there is none."""
        resources = self._open[number]
        kept = [resource for resource in resources if resource.path != path]
        if path and len(kept) == len(resources):
            raise KeyError(path)
        resources[:] = kept if path else []
        if not resources:
            del self._open[number]

    async def _notify(self, socket: WebSocket, resources: list[Watched], leaving: asyncio.Task[object]) -> None:
        sent = {resource.path: resource.read() for resource in resources}
        while resources and not leaving.done():
            for resource in tuple(resources):
                value = resource.read()
                if value != sent[resource.path]:
                    sent[resource.path] = value
                    body = f'<html><body><div class="state"><ul>{resource.message(value)}</ul></div></body></html>'
                    await socket.send_text('<?xml version="1.0" encoding="UTF-8"?>' + body)
            await asyncio.wait({leaving}, timeout=_PERIOD_S)


def add_subscriptions(app: FastAPI, cabinet: Cabinet, admits: Callable[[WebSocket], bool]) -> None:
    """Routes ``POST /subscription``, ``DELETE /subscription/N[/PATH]`` (subsrv_group_unsub_page) and ``ws /poll/N``."""
    subscriptions = Subscriptions(cabinet)

    @app.post("/subscription")
    async def subscribe(request: Request) -> Response:
        number = subscriptions.create(await fields(request))
        url = f"ws://{request.headers.get('host', '')}/poll/{number}"
        body = f'<html><body><div class="state"><a href="{url}" rel="self"></a></div></body></html>'
        return Response(body, 201, headers={"Location": url}, media_type="application/xhtml+xml")

    @app.delete("/subscription/{number}")
    @app.delete("/subscription/{number}/{path:path}")
    async def unsubscribe(number: int, path: str = "") -> Response:
        subscriptions.end(number, path and f"/{path}")
        return Response(status_code=200)

    @app.websocket("/poll/{number}")
    async def poll(socket: WebSocket, number: int) -> None:
        if admits(socket):
            await subscriptions.serve(socket, number)
        else:
            await socket.close(1008)
