"""Whoever floods the port costs memory that is bounded, and neither the robot nor a health check waits for him."""

import contextlib
import resource
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from websockets.sync.client import connect

from service.contract import wire
from service.contract.shipped import released_models
from tests.service.process import ServiceProcess, service_process

MOST_MB = 400
INFER = "/v2/models/direction.step/infer"


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServiceProcess]:
    cameras = ["--camera-left", "push:", "--camera-right", "push:", "--camera-wait-s", "0", "--requests-per-s", "0"]
    with service_process(released_models(), tmp_path_factory.mktemp("hostile") / "recordings", *cameras) as running:
        yield running


def is_served(service: ServiceProcess) -> None:
    """Health checks answer, and the robot's client is greeted."""
    assert httpx.get(service.url("/healthz"), timeout=10).status_code == 200
    assert "tactile_ready" in httpx.get(service.url("/metrics"), timeout=10).text
    path = service.url("/v1/insertion", "ws")
    with connect(path, additional_headers=service.bearer, compression=None, open_timeout=10) as link:
        name = f"robot-{time.monotonic_ns()}"
        link.send(wire.ClientHello(insertion_id=name, client="robot").model_dump_json())
        assert wire.parse_service(link.recv(20)).type == "hello"
        link.send(wire.Abort(insertion_id=name, cause="operator", reason="done").model_dump_json())
        assert wire.parse_service(link.recv(20)).type == "finished"


@contextlib.contextmanager
def most_mb(service: ServiceProcess) -> Iterator[list[float]]:
    """The largest resident memory while the context lasts, looked at fifty times a second."""
    seen, stop = [0.0], threading.Event()

    def look() -> None:
        while not stop.wait(0.02):
            seen[0] = max(seen[0], service.memory_mb()["all"])

    watcher = threading.Thread(target=look)
    watcher.start()
    try:
        yield seen
    finally:
        stop.set()
        watcher.join()


def head(service: ServiceProcess, path: str, *lines: str) -> bytes:
    token = f"Authorization: Bearer {service.token}"
    return "\r\n".join([f"POST {path} HTTP/1.1", "Host: localhost", token, *lines, "", ""]).encode()


@pytest.mark.parametrize("path", ["/v1/decisions", INFER, "/v2/repository/index", "/nowhere"])
def test_a_body_is_refused_by_its_declared_length_at_once(service: ServiceProcess, path: str) -> None:
    with socket.create_connection(("127.0.0.1", service.port), 10) as link:
        begun = time.monotonic()
        link.sendall(head(service, path, f"Content-Length: {10 * 10**9}"))
        assert link.recv(4096).startswith(b"HTTP/1.1 413 ")
        assert time.monotonic() - begun < 2.0


def test_64_bodies_at_once_stay_within_the_memory_and_the_robot_gets_in(service: ServiceProcess) -> None:
    piece, answers = b"[],[" * (1 << 18), []

    def send(number: int) -> None:
        size = (31 << 20) if number % 2 else (6 << 20)
        lines = [f"Content-Length: {size}", *(["Inference-Header-Content-Length: 8"] if number % 2 else [])]
        with socket.create_connection(("127.0.0.1", service.port), 30) as link, contextlib.suppress(OSError):
            link.sendall(head(service, INFER, *lines))
            for _ in range(size // len(piece)):
                link.sendall(piece)
            answers.append(link.recv(4096).split(b" ")[1])

    senders = [threading.Thread(target=send, args=(number,)) for number in range(64)]
    with most_mb(service) as seen:
        for sender in senders:
            sender.start()
        is_served(service)
        for sender in senders:
            sender.join(60)
    is_served(service)
    assert seen[0] < MOST_MB
    assert b"429" in answers
    assert set(answers) <= {b"400", b"429"}


def test_64_bodies_that_never_end_stay_within_the_memory_too(service: ServiceProcess) -> None:
    """In chunks, so that nothing is declared."""
    chunk = b"100000\r\n" + b"x" * (1 << 20) + b"\r\n"
    with most_mb(service) as seen, contextlib.ExitStack() as stack:
        for _ in range(64):
            link = stack.enter_context(socket.create_connection(("127.0.0.1", service.port), 10))
            link.settimeout(0.2)
            with contextlib.suppress(OSError):
                link.sendall(head(service, INFER, "Transfer-Encoding: chunked", "Inference-Header-Content-Length: 8"))
                for _ in range(30):
                    link.sendall(chunk)
        is_served(service)
    assert seen[0] < MOST_MB


@pytest.mark.parametrize("said", [b"", b"GET /healthz HTT", b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n"])
def test_two_thousand_idle_connections_keep_nobody_out(service: ServiceProcess, said: bytes) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, max(soft, 4096)), hard))
    with most_mb(service) as seen, contextlib.ExitStack() as stack:
        for number in range(2000):
            link = stack.enter_context(socket.create_connection(("127.0.0.1", service.port), 20))
            with contextlib.suppress(OSError):
                link.sendall(said)
            if number % 500 == 300:
                is_served(service)
        is_served(service)
    assert seen[0] < MOST_MB


def test_sockets_that_only_watch_are_few_and_the_robots_is_not_among_them(service: ServiceProcess) -> None:
    with contextlib.ExitStack() as stack:
        for path in ("/v1/insertion", "/v1/live"):
            for _ in range(60):
                stack.enter_context(connect(service.url(path, "ws"), open_timeout=20, close_timeout=0.1))
        is_served(service)
        assert httpx.get(service.url("/healthz")).status_code == 200


def test_the_token_lies_where_the_service_said(service: ServiceProcess) -> None:
    line = service.process.stdout.readline()
    assert str(Path(service.recordings.parent / "state" / "token")) in line
    assert service.token not in line
    assert not any(service.token in logged for logged in service.log)
