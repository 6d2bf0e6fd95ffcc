"""`python -m service run`: the service as a process."""

import contextlib
import logging
import signal
import socket
import ssl
import sys
import threading
from collections.abc import Iterator, Sequence
from typing import TextIO, cast

import cv2
import structlog
import uvicorn
from fastapi import FastAPI

from service.contract import ContractError
from service.observability.event_log import log_events
from service.observability.log_lines import LogLines
from service.observability.tracing import Spans, make_tracer
from service.session.memory import stop_searching_what_stays, use_few_arenas
from service.session.station import open_station
from service.settings import Settings, SettingsError, read_settings
from service.web.app import create_app
from service.web.patience import PatientWebSocket, http_protocol

MAX_MESSAGE_BYTES = 4 << 20
SWITCH_S = 0.0005  # a thread that waits for the interpreter waits ten times less than by default


class PortError(ContractError):
    """The port cannot be had."""


def bind(host: str, port: int) -> socket.socket:
    """A listening TCP socket; raise PortError with what to do if the port is busy or the address is not ours."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    sock = socket.socket(family, socket.SOCK_STREAM)
    try:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind((host, port))
        sock.listen(128)
    except OSError as error:
        sock.close()
        raise PortError(
            f"cannot listen on {host}:{port} ({error.strerror}); stop what uses it or pass another --port"
        ) from error
    return sock


@contextlib.contextmanager
def logging_to_standard_error(settings: Settings) -> Iterator[None]:
    """Structured lines on standard error, JSON where asked for; afterwards the library's own defaults hold again."""
    lines = LogLines(lambda: sys.stderr)
    renderer = structlog.processors.JSONRenderer() if settings.log_json else structlog.dev.ConsoleRenderer(colors=False)
    structlog.configure(
        processors=[
            structlog.contextvars.merge_contextvars,
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso"),
            structlog.processors.format_exc_info,
            renderer,
        ],
        wrapper_class=structlog.make_filtering_bound_logger(logging.INFO),
        logger_factory=structlog.WriteLoggerFactory(cast("TextIO", lines)),
    )
    try:
        yield
    finally:
        structlog.reset_defaults()
        lines.close()


@contextlib.contextmanager
def leaving_in_order() -> Iterator[None]:
    """SIGTERM unwinds like any exception, so that recordings are closed; the web server passes it on when drained."""

    def leave(_: int, __: object) -> None:
        raise SystemExit(0)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def main(arguments: Sequence[str]) -> int:
    """Serve until interrupted; bad input raises ContractError or OSError before anything listens."""
    settings = read_settings(arguments)
    check_certificate(settings)
    use_few_arenas()
    sys.setswitchinterval(SWITCH_S)
    cv2.setNumThreads(1)  # one thread a finger beats a pool that wakes for 2 ms of work
    with (
        leaving_in_order(),
        logging_to_standard_error(settings),
        contextlib.closing(bind(settings.host, settings.port)) as sock,
    ):
        station = open_station(settings)
        log_events(station.hub)
        if settings.tracing != "off":
            Spans(make_tracer(settings.tracing), station.hub)
        station.start()
        try:
            station.wait_for_cameras(settings.camera_wait_s)
            server = uvicorn.Server(web_config(create_app(station), settings))
            stop_searching_what_stays()
            scheme = "https" if settings.tls_certificate else "http"
            print(f"service ready at {scheme}://{settings.host}:{sock.getsockname()[1]}/", flush=True)
            server.run(sockets=[sock])
        finally:
            station.stop()
    return 0


def check_certificate(settings: Settings) -> None:
    """Raise SettingsError if the certificate and its key cannot serve: before, not after, the service says ready."""
    if settings.tls_certificate is None:
        return
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(settings.tls_certificate, settings.tls_key)
    except OSError as error:
        files = f"--tls-certificate {settings.tls_certificate} --tls-key {settings.tls_key}"
        raise SettingsError(f"{files}: expected a PEM certificate and its key ({error})") from error


def web_config(app: FastAPI, settings: Settings) -> uvicorn.Config:
    """How the web server runs: bounded in time, size and number; no compression, which costs more than the network."""
    return uvicorn.Config(
        app,
        http=http_protocol(),
        ws=PatientWebSocket,
        ws_per_message_deflate=False,
        ws_max_size=MAX_MESSAGE_BYTES,
        ws_ping_interval=5.0,
        ws_ping_timeout=20.0,
        log_config=None,
        access_log=False,
        server_header=False,
        timeout_keep_alive=30,
        timeout_graceful_shutdown=3,
        h11_max_incomplete_event_size=65536,
        limit_concurrency=256,
        ssl_certfile=str(settings.tls_certificate) if settings.tls_certificate else None,
        ssl_keyfile=str(settings.tls_key) if settings.tls_key else None,
    )
