"""Loopback sockets and HTTP servers of the emulators: everything on 127.0.0.1; a busy port gives one clear line."""

import contextlib
import socket
from typing import Any

import uvicorn

HOST = "127.0.0.1"


class BusyPortError(ValueError):
    """A requested port is not available."""


def _bind(kind: socket.SocketKind, port: int, name: str) -> socket.socket:
    stream = kind == socket.SOCK_STREAM
    sock = socket.socket(socket.AF_INET, kind, socket.IPPROTO_TCP if stream else 0)  # or asyncio delays
    if stream:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        sock.bind((HOST, port))
    except OSError as error:
        sock.close()
        raise BusyPortError(
            f"{name} cannot have port {port} on {HOST} ({error.strerror}); choose another one, or 0 for any free port"
        ) from error
    sock.setblocking(False)
    return sock


def bind_tcp(port: int, name: str) -> socket.socket:
    """A TCP socket bound to loopback ``port`` (0: any free one); raise BusyPortError naming the device."""
    return _bind(socket.SOCK_STREAM, port, name)


def bind_udp(port: int, name: str) -> socket.socket:
    """A UDP socket bound to loopback ``port`` (0: any free one); raise BusyPortError naming the device."""
    return _bind(socket.SOCK_DGRAM, port, name)


def port_of(sock: socket.socket) -> int:
    port: int = sock.getsockname()[1]
    return port


def free_port(kind: socket.SocketKind = socket.SOCK_STREAM) -> int:
    """A port that was free a moment ago, for a process that cannot choose one itself."""
    with contextlib.closing(_bind(kind, 0, "a probe for a free port")) as sock:
        return port_of(sock)


class HttpServer:
    """An ASGI application served from the running event loop on a socket of :func:`bind_tcp`.

    ``tls``: files of a certificate and its key.
    """

    def __init__(self, app: Any, sock: socket.socket, tls: tuple[str, str] | None = None) -> None:
        certificate, key = tls or (None, None)
        config = uvicorn.Config(
            app,
            log_level="warning",
            access_log=False,
            lifespan="off",
            server_header=False,
            ssl_certfile=certificate,
            ssl_keyfile=key,
        )
        self.port = port_of(sock)
        self._sock = sock
        self._server = uvicorn.Server(config)

    async def start(self) -> None:
        """Return once the socket accepts requests. Signals are left to the cell's own main."""
        config = self._server.config
        config.load()
        self._server.lifespan = config.lifespan_class(config)
        await self._server.startup(sockets=[self._sock])

    def abort(self, client: tuple[str, int] | None) -> None:
        """Cut the connection of a client (``request.client``) without an answer."""
        for connection in list(self._server.server_state.connections):
            if getattr(connection, "client", None) == tuple(client or ()):
                connection.transport.abort()

    def stop(self) -> None:
        for server in self._server.servers:
            server.close()
        for connection in list(self._server.server_state.connections):
            connection.transport.abort()
        self._sock.close()
