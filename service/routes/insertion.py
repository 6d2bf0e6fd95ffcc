"""The insertion WebSocket of :mod:`service.contract.wire`."""

import asyncio
import contextlib
from typing import Any

import structlog
from fastapi import APIRouter, WebSocket, WebSocketDisconnect

from service.contract import ContractError, wire
from service.contract.wire import ServiceMessage
from service.routes.access import Access
from service.station import Station

HELLO_TIMEOUT_S = 5.0
MAX_WAITING = 256
POLICY_VIOLATION = 1008
TRY_AGAIN_LATER = 1013
log = structlog.get_logger()


class Connection:
    """One client's WebSocket: messages from any thread go out in order; a client that does not read is cut off."""

    def __init__(self, socket: WebSocket) -> None:
        self._socket = socket
        self._loop = asyncio.get_running_loop()
        self._waiting: asyncio.Queue[str | None] = asyncio.Queue(MAX_WAITING)
        self.overrun = False

    def send(self, message: ServiceMessage) -> None:
        """Queue a message; may be called from any thread."""
        text = message.model_dump_json()
        last = isinstance(message, wire.Finished) or (isinstance(message, wire.Fault) and message.fatal)
        with contextlib.suppress(RuntimeError):  # the loop is gone: so is the client
            self._loop.call_soon_threadsafe(self._put, text, last)

    def _put(self, text: str, last: bool) -> None:
        try:
            self._waiting.put_nowait(text)
            if last:
                self._waiting.put_nowait(None)
        except asyncio.QueueFull:
            self.overrun = True

    async def pump(self) -> None:
        """Send what is queued until the last message or an overrun."""
        while not self.overrun:
            text = await self._waiting.get()
            if text is None:
                return
            try:
                await self._socket.send_text(text)
            except WebSocketDisconnect:
                return


def router(station: Station, access: Access) -> APIRouter:
    """Route ``/v1/insertions/ws``, also as ``/v1/insertion`` and, for clients that name no path, ``/``."""
    routes = APIRouter()

    @routes.websocket("/")
    @routes.websocket("/v1/insertion")
    @routes.websocket("/v1/insertions/ws")
    async def insertion(socket: WebSocket) -> None:
        if not await access.admit(socket, "watch"):
            return
        await socket.accept()
        connection = Connection(socket)
        pump = asyncio.create_task(connection.pump())
        talk = asyncio.create_task(_talk(socket, connection, station, access))
        try:
            await asyncio.wait({pump, talk}, return_when=asyncio.FIRST_COMPLETED)
            if talk.done():
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(pump, 1.0)
        finally:
            for task in (pump, talk):
                task.cancel()
            ended = await asyncio.gather(pump, talk, return_exceptions=True)
            for error in ended:
                if isinstance(error, Exception) and not isinstance(error, WebSocketDisconnect):
                    log.error("connection broke", error=repr(error))
            station.disconnect(connection.send)
            with contextlib.suppress(RuntimeError, WebSocketDisconnect):
                await socket.close()

    return routes


async def _talk(socket: WebSocket, connection: Connection, station: Station, access: Access) -> None:
    """Read messages until the client leaves; anything that is no message is answered by a fault."""
    try:
        hello = wire.parse_client(await asyncio.wait_for(_text(socket), HELLO_TIMEOUT_S))
        if not isinstance(hello, wire.ClientHello):
            raise ContractError(f"first message is {hello.type}, expected hello")
    except (ContractError, TimeoutError) as error:
        detail = str(error) or f"no hello within {HELLO_TIMEOUT_S:g} s"
        connection.send(wire.Fault(insertion_id="none", code="bad_message", detail=detail, fatal=True))
        return
    log.info("client", insertion=hello.insertion_id, client=hello.client, role=hello.role)
    if hello.role == "watch":
        await _watch(socket, connection, station, hello)
        return
    if not access.allows(socket, "drive"):
        detail = "this token may watch only; use the drive token"
        connection.send(wire.Fault(insertion_id=hello.insertion_id, code="forbidden", detail=detail, fatal=True))
        return
    await _drive(socket, connection, station, hello)


async def _drive(socket: WebSocket, connection: Connection, station: Station, hello: wire.ClientHello) -> None:
    send = connection.send
    station.connect(hello, send)
    while True:
        try:
            message: Any = wire.parse_client(await _text(socket))
        except ContractError as error:
            send(wire.Fault(insertion_id=hello.insertion_id, code="bad_message", detail=str(error), fatal=False))
            continue
        except WebSocketDisconnect:
            return
        station.receive(message, send)


async def _watch(socket: WebSocket, connection: Connection, station: Station, hello: wire.ClientHello) -> None:
    """Everything the driving client hears; only heartbeats are answered."""
    connection.send(
        wire.ServiceHello(
            insertion_id=hello.insertion_id,
            models=station.models.entries,
            cameras=station.camera_entries(),
            controller=station.settings.controller,
            limits=station.settings.limits,
        )
    )
    remove = station.hub.subscribe(lambda kind, content: connection.send(content) if kind == "message" else None)
    try:
        while True:
            message: Any = wire.parse_client(await _text(socket))
            if isinstance(message, wire.ClientHeartbeat):
                connection.send(
                    wire.ServiceHeartbeat(
                        insertion_id=hello.insertion_id, count=message.count, frame_age_ms=station.frame_age_ms()
                    )
                )
            else:
                detail = f"a watching client may send heartbeats only, not {message.type}"
                connection.send(
                    wire.Fault(insertion_id=hello.insertion_id, code="watch_only", detail=detail, fatal=False)
                )
    except ContractError as error:
        connection.send(wire.Fault(insertion_id=hello.insertion_id, code="bad_message", detail=str(error), fatal=True))
    except WebSocketDisconnect:
        return
    finally:
        remove()


async def _text(socket: WebSocket) -> str:
    """The next text frame; a binary one is refused (frames are pushed on their own path)."""
    event = await socket.receive()
    if event["type"] == "websocket.disconnect":
        raise WebSocketDisconnect(event.get("code", 1000))
    text = event.get("text")
    if text is None:
        raise ContractError("binary frame on the insertion channel, expected JSON text")
    return str(text)
