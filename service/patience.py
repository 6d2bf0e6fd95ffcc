"""A web server that does not wait for ever: connections that never say what they want are closed."""

import asyncio

from uvicorn.protocols.http.h11_impl import H11Protocol

HEAD_TIMEOUT_S = 10.0


class PatientProtocol(H11Protocol):
    """HTTP/1.1 with a deadline on the head of each request: half a request cannot hold a connection for ever."""

    _deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """A client connected: the clock runs."""
        super().connection_made(transport)
        self._wait()

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

    def connection_lost(self, exc: Exception | None) -> None:
        """The client left."""
        self._stop_waiting()
        super().connection_lost(exc)

    def _wait(self) -> None:
        if self._deadline is None:
            self._deadline = self.loop.call_later(HEAD_TIMEOUT_S, self.transport.close)

    def _stop_waiting(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None
