"""A web server that does not wait for ever: connections that never say what they want, or never read, are closed."""

import asyncio
from typing import TYPE_CHECKING

from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.utils import ClientDisconnected
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

if TYPE_CHECKING:
    from uvicorn._types import ASGISendEvent

HEAD_TIMEOUT_S = 10.0
READ_TIMEOUT_S = 20.0  # for a client to read what waits for it, some 64 KiB and a message
GONE_S = 12.0  # from the end of a conversation to the end of its connection; a close frame has 10 s to be answered


class Unread:
    """Cuts off a connection whose client has stopped to read: else it, and all it holds, would stay for ever."""

    def __init__(self) -> None:
        self._deadline: asyncio.TimerHandle | None = None

    def begin(self, transport: asyncio.Transport, after_s: float) -> None:
        """The clock runs; what is written and not read is dropped with the connection."""
        self.end()
        self._deadline = asyncio.get_running_loop().call_later(after_s, transport.abort)

    def end(self) -> None:
        """The client has read, or is gone."""
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None


class Patient(asyncio.Protocol):
    """The clocks of an HTTP connection: one on the head of each request, one on what its client does not read.

    Mixed into a protocol of the web server, of which it uses ``loop`` and ``transport``.
    """

    loop: asyncio.AbstractEventLoop
    transport: asyncio.Transport
    _deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """A client connected: the clock runs."""
        super().connection_made(transport)
        self._unread = Unread()
        self._wait()

    def pause_writing(self) -> None:
        """More waits for the client than should."""
        super().pause_writing()
        self._unread.begin(self.transport, READ_TIMEOUT_S)

    def resume_writing(self) -> None:
        """The client reads."""
        super().resume_writing()
        self._unread.end()

    def connection_lost(self, exc: Exception | None) -> None:
        """The client left."""
        self._stop_waiting()
        self._unread.end()
        super().connection_lost(exc)

    def _wait(self) -> None:
        if self._deadline is None:
            self._deadline = self.loop.call_later(HEAD_TIMEOUT_S, self.transport.close)

    def _stop_waiting(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None


class PatientH11(Patient, H11Protocol):
    """HTTP/1.1 in Python alone: half a request cannot hold a connection for ever."""

    def data_received(self, data: bytes) -> None:
        """Bytes came; the clock stops while a request is under way and runs again while one is awaited."""
        super().data_received(data)
        asking = self.cycle is None or self.cycle.response_complete
        if asking and not self.transport.is_closing() and self.transport.get_protocol() is self:
            self._wait()
        else:
            self._stop_waiting()

    def on_response_complete(self) -> None:
        """An answer is out; if the beginning of a further request came meanwhile, the clock runs for it."""
        super().on_response_complete()
        if self.conn.trailing_data[0] and not self.transport.is_closing():
            self._wait()


def http_protocol() -> type[asyncio.Protocol]:
    """HTTP/1.1 with the parser in C where ``httptools`` is installed, else the one in Python."""
    try:
        from service.web.patience_c import PatientHttpTools
    except ImportError:
        return PatientH11
    return PatientHttpTools


class PatientWebSocket(WebSocketsSansIOProtocol):
    """A WebSocket whose client may be slow to read, but not for ever."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """A client connected, or was handed over by HTTP."""
        super().connection_made(transport)
        self._unread = Unread()

    def pause_writing(self) -> None:
        """More waits for the client than should."""
        super().pause_writing()
        self._unread.begin(self.transport, READ_TIMEOUT_S)

    def resume_writing(self) -> None:
        """The client reads; once the conversation is over this no longer matters."""
        super().resume_writing()
        if not (self.close_sent or self.transport.is_closing()):
            self._unread.end()

    def keepalive_timeout(self) -> None:
        """No answer to a ping: say so, and do not wait for it to be read."""
        super().keepalive_timeout()
        self._unread.begin(self.transport, GONE_S)

    def on_task_complete(self, task: asyncio.Task[None]) -> None:
        """The conversation is over."""
        super().on_task_complete(task)
        if self in self.connections:
            self._unread.begin(self.transport, GONE_S)

    def connection_lost(self, exc: Exception | None) -> None:
        """The client left."""
        self._unread.end()
        super().connection_lost(exc)

    async def send(self, message: "ASGISendEvent") -> None:
        """Once the server itself has said goodbye (no answer to a ping), nobody is there any more."""
        if self.handshake_complete and self.close_sent:
            raise ClientDisconnected
        await super().send(message)
