"""The web server: bounds on time, size and number, set with options of the kernel and of uvicorn."""

import asyncio
import socket
import ssl

import uvicorn
from fastapi import FastAPI
from uvicorn.protocols.http.h11_impl import H11Protocol, RequestResponseCycle

from service.contract import ContractError
from service.settings import Settings, SettingsError

HEAD_TIMEOUT_S = 10.0  # without a complete request; a connection is closed after one to two of these
READ_TIMEOUT_S = 20.0  # without any sign that the client reads
MAX_HEAD_BYTES = 64 << 10
MAX_MESSAGE_BYTES = 4 << 20


class PortError(ContractError):
    """The port cannot be had."""


def bind(host: str, port: int) -> socket.socket:
    """A listening TCP socket; raise PortError with what to do if the port is busy or the address is not ours.

    The kernel drops connections whose client reads nothing for ``READ_TIMEOUT_S``.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    sock = socket.socket(family, socket.SOCK_STREAM)
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


class PunctualH11(H11Protocol):
    """HTTP/1.1 whose clients cannot hold a connection with half a request; uvicorn has no option for that."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self.loop.call_later(HEAD_TIMEOUT_S, self._close_if_silent, None)

    def _close_if_silent(self, last: RequestResponseCycle | None) -> None:
        """Close unless a request is being answered or one came since the last look."""
        if self.transport.is_closing() or self.transport.get_protocol() is not self:
            return
        if self.cycle is last and (last is None or last.response_complete):
            self.transport.close()
        else:
            self.loop.call_later(HEAD_TIMEOUT_S, self._close_if_silent, self.cycle)


def web_config(app: FastAPI, settings: Settings) -> uvicorn.Config:
    """How the web server runs: bounded in time, size and number; no compression, which costs more than the network."""
    return uvicorn.Config(
        app,
        http=PunctualH11,
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
        limit_concurrency=256,
        ssl_certfile=str(settings.tls_certificate) if settings.tls_certificate else None,
        ssl_keyfile=str(settings.tls_key) if settings.tls_key else None,
    )
