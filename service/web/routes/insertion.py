"""The insertion WebSocket of :mod:`service.contract.wire`."""

import asyncio
import contextlib
from typing import Any

import structlog
from fastapi import APIRouter, WebSocket, WebSocketDisconnect

from service.cameras.capture import now_ns
from service.contract import ContractError, wire
from service.contract.replies import beat, clock, greeting_of, unspoken
from service.contract.wire import ServiceMessage
from service.observability.hub import Hub
from service.session.station import Station
from service.web.access import Access
from service.web.closing import (
    GOING_AWAY,
    NORMAL,
    POLICY_VIOLATION,
    TRY_AGAIN_LATER,
    Ending,
    Slots,
    close,
    until_gone,
    until_one_ends,
)
from service.web.routes.cameras import examined

HELLO_TIMEOUT_S = 30.0  # a robot client connects first, then switches motors on and waits for the arm to be guided
MAX_WAITING = 256
MAX_WATCHERS = 8  # connections that may not drive, which leaves room for the one that does
log = structlog.get_logger()


class Connection:
    """One client's WebSocket: messages from any thread go out in order; a client that does not read is cut off.

    ``hub`` gets the code of a fatal fault as ``turned_away``: a client that is refused opens no insertion to count. One
    that only ``watches`` would have opened none.
    """

    def __init__(self, socket: WebSocket, hub: Hub) -> None:
        self._socket, self._hub = socket, hub
        self._loop = asyncio.get_running_loop()
        self._waiting: asyncio.Queue[tuple[str, Ending | None]] = asyncio.Queue(MAX_WAITING)
        self._overrun = asyncio.Event()
        self.insertion_id, self.watches = "none", False

    def send(self, message: ServiceMessage) -> None:
        """Queue a message; may be called from any thread."""
        if isinstance(message, wire.Fault) and message.fatal and not self.watches:
            self._hub.publish("turned_away", message.code)
        text, ending = message.model_dump_json(), ending_of(message)
        with contextlib.suppress(RuntimeError):  # the loop is gone: so is the client
            self._loop.call_soon_threadsafe(self._put, text, ending)

    def _put(self, text: str, ending: Ending | None) -> None:
        try:
            self._waiting.put_nowait((text, ending))
        except asyncio.QueueFull:
            self._overrun.set()

    def fault(self, code: wire.FaultCode, detail: str, *, fatal: bool) -> None:
        """Queue a fault of this connection."""
        self.send(wire.Fault(insertion_id=self.insertion_id, code=code, detail=detail, fatal=fatal))

    async def pump(self) -> Ending:
        """Send what is queued, up to the message that ends the conversation."""
        while True:
            text, ending = await self._waiting.get()
            await self._socket.send_text(text)
            if ending is not None:
                return ending

    async def overrun(self) -> Ending:
        """Wait until too many messages wait for this client."""
        await self._overrun.wait()
        return Ending(POLICY_VIOLATION, f"{MAX_WAITING} messages wait for this client to read them")


def ending_of(message: ServiceMessage) -> Ending | None:
    """How a conversation ends with this message, None if it goes on."""
    match message:
        case wire.Finished():
            return Ending(NORMAL, f"insertion {message.outcome}")
        case wire.Fault(fatal=True):
            code = TRY_AGAIN_LATER if message.code == "busy" else POLICY_VIOLATION
            return Ending(code, f"{message.code}: {message.detail}")
    return None


def router(station: Station, access: Access) -> APIRouter:
    """Route ``/v1/insertion``, and for clients that name no path ``/``."""
    routes = APIRouter()
    watchers = Slots(MAX_WATCHERS)

    @routes.websocket("/")
    @routes.websocket("/v1/insertion")
    async def insertion(socket: WebSocket) -> None:
        if not await access.admit(socket, "watch"):
            if access.same_origin(socket):  # another page in a browser is no robot's client; who watches may count
                station.hub.publish("turned_away", "forbidden")
            return
        await socket.accept()
        if access.allows(socket, "drive"):
            await converse(socket)
        else:
            async with watchers.taken(socket) as admitted:
                if admitted:
                    await converse(socket)

    async def converse(socket: WebSocket) -> None:
        connection = Connection(socket, station.hub)
        ending = Ending(GOING_AWAY, "the service stops")
        try:
            serving = _serve(socket, connection, station, access)
            ending = await until_one_ends(socket, connection.pump(), serving, connection.overrun())
        finally:
            station.disconnect(connection.send)
            log.info("client gone", insertion=connection.insertion_id, code=ending.code, reason=ending.reason)
            await close(socket, ending)

    return routes


async def _serve(socket: WebSocket, connection: Connection, station: Station, access: Access) -> Ending:
    """Read messages until the client leaves; anything else is answered by a fault."""
    try:
        text = await asyncio.wait_for(_text(socket), HELLO_TIMEOUT_S)
        if greeting := greeting_of(text):
            connection.watches = greeting.role == "watch"
            if refused := unspoken(greeting):
                connection.send(refused)
                return await until_gone(socket)
        hello = wire.parse_client(text)
        if not isinstance(hello, wire.ClientHello):
            raise ContractError(f"first message is {hello.type}, expected hello")
    except (ContractError, TimeoutError) as error:
        connection.fault("bad_message", str(error) or f"no hello within {HELLO_TIMEOUT_S:g} s", fatal=True)
        return await until_gone(socket)
    connection.insertion_id = hello.insertion_id
    log.info("client", insertion=hello.insertion_id, client=hello.client, role=hello.role)
    if hello.role == "watch":
        return await _watch(socket, connection, station, hello)
    if not access.allows(socket, "drive"):
        connection.fault("forbidden", "without the token for driving a client may only watch", fatal=True)
        return await until_gone(socket)
    return await _drive(socket, connection, station, hello)


async def _drive(socket: WebSocket, connection: Connection, station: Station, hello: wire.ClientHello) -> Ending:
    station.connect(hello, connection.send)
    while True:
        station.receive(await _message(socket, connection), connection.send)


async def _watch(socket: WebSocket, connection: Connection, station: Station, hello: wire.ClientHello) -> Ending:
    """Send every message of the driving client; only heartbeats are answered."""
    name = connection.insertion_id
    connection.send(
        wire.ServiceHello(
            insertion_id=name,
            clock=clock(hello, now_ns()),
            models=station.models.entries,
            cameras=await asyncio.to_thread(examined, station),
            controller=station.settings.controller,
            limits=station.settings.limits,
        )
    )
    remove = station.hub.subscribe(lambda kind, content: connection.send(content) if kind == "message" else None)
    try:
        while True:
            message = await _message(socket, connection)
            if isinstance(message, wire.ClientHeartbeat):
                connection.send(beat(message, now_ns(), station.frame_age_ms()))
            else:
                detail = f"a watching client may send heartbeats only, not {message.type}"
                connection.fault("watch_only", detail, fatal=False)
    finally:
        remove()


async def _message(socket: WebSocket, connection: Connection) -> Any:
    """The next message after hello; what is none is answered by a fault, and changes nothing."""
    while True:
        try:
            return wire.parse_client(await _text(socket))
        except ContractError as error:
            connection.fault("bad_message", str(error), fatal=False)


async def _text(socket: WebSocket) -> str:
    """The next text frame; a binary one is refused (frames are pushed on their own path)."""
    event = await socket.receive()
    if event["type"] == "websocket.disconnect":
        raise WebSocketDisconnect(event.get("code", 1000))
    text = event.get("text")
    if text is None:
        raise ContractError("binary frame on the insertion channel, expected JSON text")
    return str(text)
