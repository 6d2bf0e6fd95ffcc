"""Flooding the port costs bounded memory, and neither the robot nor a health check has to wait."""

import contextlib
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from websockets.sync.client import connect

from tests.benchmarks.hostile import MOST_MB, NO_CAMERAS, bodies, greeted_s, head, idle, most_mb
from tests.service.process import ServiceProcess, service_process
from tests.waiting import wait_for

MODELS = Path(__file__).parents[3] / "models"
INFER = "/v2/models/direction.step/infer"


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServiceProcess]:
    recordings = tmp_path_factory.mktemp("hostile") / "recordings"
    with service_process(MODELS, recordings, *NO_CAMERAS) as running:
        yield running


@pytest.mark.parametrize(
    ("path", "bytes_n"),
    [
        *((path, 10 * 10**9) for path in ("/v1/decisions", INFER, "/v2/repository/index", "/nowhere")),
        ("/v1/decisions", (16 << 20) + 1),
        (INFER, (6 << 20) + 1),  # as JSON
    ],
)
def test_a_body_is_refused_by_its_declared_length_at_once(service: ServiceProcess, path: str, bytes_n: int) -> None:
    with socket.create_connection(("127.0.0.1", service.port), 10) as link:
        begun = time.monotonic()
        link.sendall(head(service, path, f"Content-Length: {bytes_n}"))
        assert link.recv(4096).startswith(b"HTTP/1.1 413 ")
        assert time.monotonic() - begun < 2.0


def test_64_bodies_at_once_stay_within_the_memory_and_the_robot_gets_in(service: ServiceProcess) -> None:
    figures = bodies(service)
    greeted_s(service)
    assert figures["most_mb"] < MOST_MB
    assert "429" in figures["answers"]
    assert set(figures["answers"]) <= {"400", "429"}


@pytest.mark.slow
def test_64_bodies_that_never_end_stay_within_the_memory_too(service: ServiceProcess) -> None:
    """In chunks, so that no length is declared."""
    chunk = b"100000\r\n" + b"x" * (1 << 20) + b"\r\n"
    with most_mb(service) as most, contextlib.ExitStack() as stack:
        for _ in range(64):
            link = stack.enter_context(socket.create_connection(("127.0.0.1", service.port), 10))
            link.settimeout(0.2)
            with contextlib.suppress(OSError):
                link.sendall(head(service, INFER, "Transfer-Encoding: chunked", "Inference-Header-Content-Length: 8"))
                for _ in range(30):
                    link.sendall(chunk)
        greeted_s(service)
    assert most[0] < MOST_MB


@pytest.mark.slow
@pytest.mark.parametrize("sent", [b"", b"GET /healthz HTT", b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n"])
def test_two_thousand_idle_connections_keep_nobody_out(service: ServiceProcess, sent: bytes) -> None:
    assert idle(service, sent)["most_mb"] < MOST_MB


def test_sockets_that_only_watch_are_few_and_the_robots_is_not_among_them(service: ServiceProcess) -> None:
    with contextlib.ExitStack() as stack:
        crowds = [
            [stack.enter_context(connect(url, open_timeout=20, close_timeout=0.1)) for _ in range(60)]
            for url in (service.url("/v1/insertion", "ws"), service.url("/v1/live", "ws"))
        ]
        wait_for(lambda: [sum(link.close_code == 1013 for link in links) for links in crowds] == [60 - 8, 60 - 24])
        greeted_s(service)
        assert httpx.get(service.url("/healthz")).status_code == 200


def test_the_token_lies_where_the_service_said(service: ServiceProcess) -> None:
    line = service.process.stdout.readline()
    assert str(Path(service.recordings.parent / "state" / "token")) in line
    assert service.token not in line
    assert not any(service.token in logged for logged in service.log)


@pytest.mark.parametrize("length", [b"\xb2", b"9" * 5000, b"-1", b"3"])
def test_a_length_of_the_header_that_is_none_is_an_error_that_says_so(service: ServiceProcess, length: bytes) -> None:
    headers = [(name.encode(), value.encode()) for name, value in service.bearer.items()]
    headers.append((b"Inference-Header-Content-Length", length))
    answer = httpx.post(service.url(INFER), content=b"{}", headers=headers)
    assert answer.status_code == 400
    assert "expected a length within the body" in answer.json()["error"]
