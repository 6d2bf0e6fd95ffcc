"""The web server: limits on time, size and number, set with options of the kernel and of uvicorn."""

import asyncio
import contextlib
import resource
import socket
import ssl
import time
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any
from weakref import WeakKeyDictionary

import uvicorn
from fastapi import FastAPI

from service.contract import ContractError
from service.settings import Settings, SettingsError
from service.web.closing import STREAM

HEAD_TIMEOUT_S = 10.0  # without a complete request
LEAVE_TIMEOUT_S = 1.0  # from the end of TLS until the client has answered it
READ_TIMEOUT_S = 20.0  # without any sign of the client reading
MAX_HEAD_BYTES = 16 << 10
MAX_MESSAGE_BYTES = 4 << 20
MAX_WAITING = 256  # connections without a request


class PortError(ContractError):
    """The port is not available."""


def bind(host: str, port: int) -> socket.socket:
    """A listening TCP socket; raise PortError with the remedy if the port is busy or the address is not ours.

    The kernel drops connections whose client reads nothing for ``READ_TIMEOUT_S``. The protocol is named because
    asyncio sends without delay only for a named one: otherwise answers wait 40 ms for an acknowledgement.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    sock = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(READ_TIMEOUT_S * 1e3))
        sock.bind((host, port))
        sock.listen(128)
    except OSError as error:
        sock.close()
        raise PortError(
            f"cannot listen on {host}:{port} ({error.strerror}); stop what uses it or pass another --port"
        ) from error
    return sock


def check_certificate(settings: Settings) -> None:
    """Raise SettingsError if the certificate and its key are unusable, before the service is ready."""
    if settings.tls_certificate is None:
        return
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(settings.tls_certificate, settings.tls_key)
    except OSError as error:
        files = f"--tls-certificate {settings.tls_certificate} --tls-key {settings.tls_key}"
        raise SettingsError(f"{files}: expected a PEM certificate and its key ({error})") from error


def open_many_files() -> None:
    """Raise this process's limit of open files and connections to the system's maximum."""
    with contextlib.suppress(ValueError, OSError):
        hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


@dataclass(slots=True)
class Waiting:
    """Closes idle connections, so that active clients get in: the silent ones, and the oldest of too many.

    ``connections`` are uvicorn's protocols. One is idle while none of its requests is being answered.
    """

    connections: Collection[Any]
    _since: WeakKeyDictionary[Any, tuple[Any, float | None]] = field(default_factory=WeakKeyDictionary)

    def look(self) -> None:
        """Check the connections; the web server calls this ten times per second."""
        now_s = time.monotonic()
        waiting: list[tuple[float, Any]] = []
        for connection in tuple(self.connections):
            if not hasattr(connection, "cycle"):
                continue  # a WebSocket
            cycle = connection.cycle
            if cycle is not None and not cycle.response_complete:
                continue  # a request is being answered
            last, since_s = self._since.get(connection, (None, None))
            if since_s is None or last is not cycle:  # new: its first request may not have been read yet
                self._since[connection] = cycle, now_s
            else:
                waiting.append((since_s, connection))
        waiting.sort(key=lambda one: one[0])
        too_many = len(waiting) - MAX_WAITING
        for number, (since_s, connection) in enumerate(waiting):
            if number < too_many or now_s - since_s > HEAD_TIMEOUT_S:
                connection.transport.close()


class Loop(asyncio.SelectorEventLoop):
    """An event loop that gives TLS handshakes no more time than other requests: each holds 0.3 MB, by default 60 s.

    A client that does not answer the end of TLS is not waited for, by default 30 s: the service may be stopping.
    """

    async def create_server(self, *args: Any, **options: Any) -> asyncio.Server:
        """As the standard one."""
        if options.get("ssl") is not None:
            options |= {"ssl_handshake_timeout": HEAD_TIMEOUT_S, "ssl_shutdown_timeout": LEAVE_TIMEOUT_S}
        return await super().create_server(*args, **options)


class Server(uvicorn.Server):
    """Waits at its end for answers under way, but not for streams of pictures, which end with their viewers only.

    A WebSocket whose client is just leaving is closed already: uvicorn would close it again, and end with an error.
    Its own callback is made once a second by the wall clock: one set back by an hour would keep it waiting as long.
    """

    def __init__(self, config: uvicorn.Config) -> None:
        super().__init__(config)
        self._waiting = Waiting(self.server_state.connections)

    async def on_tick(self, counter: int) -> bool:
        """Ten times a second: True if the server should stop, as the standard one."""
        self._waiting.look()
        return await super().on_tick(counter)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Stop, as the standard one."""
        connections: tuple[Any, ...] = tuple(self.server_state.connections)
        for connection in connections:
            cycle = getattr(connection, "cycle", None)
            if cycle is not None and cycle.scope["path"].endswith(STREAM):
                connection.transport.close()
            if connection.transport.is_closing():
                connection.close_sent = True
        await super().shutdown(sockets)


def web_server(app: FastAPI, settings: Settings) -> uvicorn.Server:
    """The web server: limited in time, size and number; no compression, which costs more than the network.

    A proxy's headers are not trusted: the address of a client is that of its connection.
    """
    config = uvicorn.Config(
        app,
        http="h11",
        loop=f"{__name__}:{Loop.__name__}",
        proxy_headers=False,
        ws_per_message_deflate=False,
        ws_max_size=MAX_MESSAGE_BYTES,
        ws_ping_interval=5.0,
        ws_ping_timeout=20.0,
        log_config=None,
        access_log=False,
        server_header=False,
        timeout_keep_alive=10,
        timeout_graceful_shutdown=3,
        h11_max_incomplete_event_size=MAX_HEAD_BYTES,
        ssl_certfile=str(settings.tls_certificate) if settings.tls_certificate else None,
        ssl_keyfile=str(settings.tls_key) if settings.tls_key else None,
    )
    return Server(config)
