"""`python -m service run`: the service as a process."""

import contextlib
import logging
import signal
import sys
import threading
from collections.abc import Iterator, MutableMapping, Sequence
from typing import Any, TextIO, cast

import cv2
import structlog

from service.contract.text import printable
from service.observability.event_log import log_events
from service.observability.log_lines import LogLines
from service.perception.identity import untold
from service.session.memory import stop_searching_what_stays, use_few_arenas
from service.session.station import open_station
from service.settings import Settings, read_settings
from service.web.app import create_app, warm
from service.web.server import bind, check_certificate, open_many_files, web_server

SWITCH_S = 0.0005  # a thread waits ten times less for the interpreter than by default


def harmless(_: object, __: str, line: MutableMapping[str, Any]) -> MutableMapping[str, Any]:
    """Escape control characters that clients and cameras may have put into a text; tracebacks are ours."""
    return {key: printable(v) if isinstance(v, str) and key != "exception" else v for key, v in line.items()}


@contextlib.contextmanager
def logging_to_standard_error(settings: Settings) -> Iterator[None]:
    """Structured lines on standard error, JSON if configured; afterwards the library's defaults apply again.

    Warnings of libraries go the same way: the web server warns in the event loop, of any request that is no HTTP.
    """
    lines = LogLines(lambda: sys.stderr)
    warnings = logging.StreamHandler(cast("TextIO", lines))
    logging.getLogger().addHandler(warnings)
    renderer = structlog.processors.JSONRenderer() if settings.log_json else structlog.dev.ConsoleRenderer(colors=False)
    structlog.configure(
        processors=[
            structlog.contextvars.merge_contextvars,
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso"),
            structlog.processors.format_exc_info,
            harmless,
            renderer,
        ],
        wrapper_class=structlog.make_filtering_bound_logger(logging.INFO),
        logger_factory=structlog.WriteLoggerFactory(cast("TextIO", lines)),
    )
    try:
        yield
    finally:
        structlog.reset_defaults()
        logging.getLogger().removeHandler(warnings)
        lines.close()


@contextlib.contextmanager
def leaving_in_order() -> Iterator[None]:
    """SIGTERM unwinds like any exception, so that recordings are closed; the web server passes it on when drained.

    A terminal that is closed does the same, unless that is ignored (nohup).
    """

    def leave(_: int, __: object) -> None:
        raise SystemExit(0)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {signal.SIGTERM: signal.signal(signal.SIGTERM, leave)}
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        before[signal.SIGHUP] = signal.signal(signal.SIGHUP, lambda *_: signal.raise_signal(signal.SIGTERM))
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def main(arguments: Sequence[str]) -> int:
    """Serve until interrupted; invalid input raises ContractError or OSError before anything listens."""
    settings = read_settings(arguments)
    check_certificate(settings)
    use_few_arenas()
    open_many_files()
    sys.setswitchinterval(SWITCH_S)
    cv2.setNumThreads(1)  # one thread per finger beats a pool that wakes for 2 ms of work
    with (
        leaving_in_order(),
        logging_to_standard_error(settings),
        contextlib.closing(bind(settings.host, settings.port)) as sock,
    ):
        station = open_station(settings)
        log_events(station.hub)
        if why := untold(station.manager.calibration):
            structlog.get_logger().warning("calibration", detail=f"{why}; calibrate and commission again")
        station.start()
        try:
            station.wait_for_cameras(settings.camera_wait_s)
            app = create_app(station)
            warm(app)
            server = web_server(app, settings)
            stop_searching_what_stays()
            scheme = "https" if settings.tls_certificate else "http"
            print(f"service ready at {scheme}://{settings.host_in_url}:{sock.getsockname()[1]}/", flush=True)
            if app.state.access.token_file:
                print(f"the token for driving and administration is in {app.state.access.token_file}", flush=True)
            server.run(sockets=[sock])
        finally:
            station.stop()
    return 0
