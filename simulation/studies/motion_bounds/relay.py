"""A bad network between client and service: a TCP relay in its own thread, with switchable faults."""

import asyncio
import contextlib
import threading
from dataclasses import dataclass, field
from typing import Literal, Self
from urllib.parse import urlsplit

from simulation.cell.emulators.net import HOST

Way = Literal["fair", "drip", "half open", "half open to client", "reset", "late"]
DRIP_S = 0.01


@dataclass(slots=True)
class Relay:
    """Passes bytes both ways to ``host:port``; ``way`` may change at any time, ``late_s`` is the delay of ``late``."""

    host: str
    port: int
    way: Way = "fair"
    late_s: float = 0.0
    own_port: int = 0
    _loop: asyncio.AbstractEventLoop = field(default_factory=asyncio.new_event_loop)
    _writers: list[asyncio.StreamWriter] = field(default_factory=list)
    _ready: threading.Event = field(default_factory=threading.Event)
    _thread: threading.Thread | None = None

    @classmethod
    def to(cls, url: str) -> Self:
        """A running relay to the service at ``url``."""
        parts = urlsplit(url)
        relay = cls(parts.hostname or HOST, parts.port or 80)
        relay._thread = threading.Thread(target=relay._run, name="relay", daemon=True)
        relay._thread.start()
        relay._ready.wait()
        return relay

    @property
    def url(self) -> str:
        """The address to give to the client."""
        return f"http://{HOST}:{self.own_port}"

    def misbehave(self, way: Way, late_s: float = 0.0) -> None:
        self.way, self.late_s = way, late_s
        if way == "reset":
            for writer in self._writers:
                self._loop.call_soon_threadsafe(writer.transport.abort)

    def close(self) -> None:
        """End the thread."""
        self._loop.call_soon_threadsafe(self._loop.stop)
        if self._thread is not None:
            self._thread.join(5.0)

    def _run(self) -> None:
        server = self._loop.run_until_complete(asyncio.start_server(self._serve, HOST, 0))
        self.own_port = server.sockets[0].getsockname()[1]
        self._ready.set()
        self._loop.run_forever()
        self._loop.run_until_complete(self._end(server))
        self._loop.close()

    async def _end(self, server: asyncio.Server) -> None:
        """Close all sockets, which takes the loop another turn after they are aborted."""
        server.close()
        for writer in self._writers:
            writer.transport.abort()
        serving = asyncio.all_tasks() - {asyncio.current_task()}
        for task in serving:
            task.cancel()
        ends = (writer.wait_closed() for writer in self._writers)
        await asyncio.gather(*serving, *ends, return_exceptions=True)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        there, back = await asyncio.open_connection(self.host, self.port)
        self._writers += [writer, back]
        await asyncio.gather(self._pass(reader, back, down=False), self._pass(there, writer, down=True))

    async def _pass(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, *, down: bool) -> None:
        """``down``: from the service to the client."""
        with contextlib.suppress(ConnectionError):
            while data := await reader.read(65536):
                if self.way == "half open" or (self.way == "half open to client" and down):
                    continue
                if self.way == "late":
                    self._loop.call_later(self.late_s, _put, writer, data)
                elif self.way == "drip" and down:
                    await _drip(writer, data)
                else:
                    _put(writer, data)
        if self.way == "fair":
            writer.close()


async def _drip(writer: asyncio.StreamWriter, data: bytes) -> None:
    for byte in data:
        _put(writer, bytes([byte]))
        await asyncio.sleep(DRIP_S)


def _put(writer: asyncio.StreamWriter, data: bytes) -> None:
    if not writer.is_closing():
        writer.write(data)
