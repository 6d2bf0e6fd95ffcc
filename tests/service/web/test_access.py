"""Who comes in, how fast, and over what: tokens, origins, rates, time limits, TLS. On real sockets."""

import asyncio
import contextlib
import itertools
import shutil
import socket
import ssl
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import httpx
import pytest
from fastapi import FastAPI
from hypothesis import given
from hypothesis import strategies as st
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.frames import Frame, Opcode
from websockets.sync.client import connect

from service.contract import wire
from service.settings import SettingsError, read_settings
from service.web import middleware, server
from service.web.middleware import BURST_S, Rate
from tests.service.conftest import LiveService, live_service
from tests.waiting import wait_for

ROOT = Path(__file__).parents[3]
WATCH, DRIVE = "a-token-for-watching", "a-token-for-driving"


@given(per_s=st.floats(0.5, 50), waits=st.lists(st.floats(0, 2), max_size=200))
def test_no_client_gets_more_than_its_rate_and_its_burst(per_s: float, waits: list[float]) -> None:
    rate = Rate(per_s)
    times = [1000.0, *(1000.0 + t for t in itertools.accumulate(waits))]
    passed = [t for t in times if rate.allows("a", t)]
    assert len(passed) <= max(1.0, per_s * BURST_S) + per_s * (times[-1] - times[0]) + 1
    assert Rate(per_s).allows("a", 0.0)
    assert rate.allows("another", times[-1])


def test_a_rate_of_nothing_is_no_limit_and_old_clients_are_forgotten() -> None:
    assert all(Rate(0).allows("a") for _ in range(10_000))
    rate = Rate(1.0)
    for client in range(middleware.MAX_ADDRESSES + 10):
        rate.allows(str(client), 0.0)
    assert len(rate._left) == middleware.MAX_ADDRESSES


def test_a_client_too_fast_is_told_to_slow_down_and_health_goes_on(tmp_path: Path, models_folder: Path) -> None:
    with live_service(tmp_path, models_folder, requests_per_s=0.5) as slow:
        first, *others = (httpx.get(slow.url("/v1/models")) for _ in range(4))
        assert first.status_code == 200
        refused = next(answer for answer in others if answer.status_code == 429)
        assert (refused.headers["retry-after"], refused.headers["connection"]) == ("1", "close")
        assert "more than 0.5 requests a second" in refused.json()["error"]

        def open_pages() -> None:
            with contextlib.ExitStack() as pages:
                for _ in range(4):
                    pages.enter_context(connect(slow.url("/v1/live", "ws")))

        with pytest.raises(InvalidStatus) as too_fast:
            open_pages()
        assert too_fast.value.response.status_code == 429
        assert b"more than 0.5 requests a second" in too_fast.value.response.body
        assert {httpx.get(slow.url("/healthz")).status_code for _ in range(10)} == {200}


def test_idle_connections_are_closed_also_after_the_wall_clock_was_set_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "HEAD_TIMEOUT_S", -1.0)
    settings: Any = SimpleNamespace(tls_certificate=None, tls_key=None)
    serving, idle = server.web_server(FastAPI(), settings), Mock(cycle=None)
    serving.server_state.connections.add(idle)
    serving.last_notified = time.time() + 3600.0
    for tick in range(1, 3):
        assert asyncio.run(serving.on_tick(tick)) is False
    idle.transport.close.assert_called_once_with()


def test_half_a_request_is_not_waited_for(live: LiveService, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "HEAD_TIMEOUT_S", 0.2)
    with contextlib.ExitStack() as stack:
        links = {}
        for request in (b"", b"GET /healthz HTT", b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\nGET /heal"):
            links[request] = stack.enter_context(socket.create_connection(("127.0.0.1", live.port), 20))
            links[request].sendall(request)
        for request, link in links.items():
            heard = b""
            while piece := link.recv(4096):  # ends when the service closes, else by the socket's own 20 s
                heard += piece
            assert heard.count(b"200 OK") == request.count(b"\r\n\r\n")


def test_a_head_without_end_is_refused(live: LiveService) -> None:
    with socket.create_connection(("127.0.0.1", live.port), 20) as link:
        heard = b""
        with contextlib.suppress(ConnectionError):  # what it answers may be lost with the connection
            link.sendall(b"GET /healthz HTTP/1.1\r\n")
            for number in range(100):
                link.sendall(f"X-{number}: {'x' * 4000}\r\n".encode())
            while piece := link.recv(4096):  # the end of the connection, else this times out
                heard += piece
        assert heard == b"" or b" 400 " in heard.splitlines()[0]


def test_a_body_that_does_not_come_is_408(live: LiveService, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(middleware, "BODY_TIMEOUT_S", 0.2)
    with socket.create_connection(("127.0.0.1", live.port), 20) as link:
        head = f"POST /v1/decisions HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {live.token}\r\n"
        link.sendall(f"{head}Content-Length: 1000\r\n\r\nabc".encode())
        assert b"408" in link.recv(4096).split(b"\r\n")[0]


def test_a_body_too_large_is_refused(live: LiveService, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.web.routes.api.MAX_BODY_BYTES", 1000)
    monkeypatch.setattr("service.web.routes.oip.MAX_BODY_BYTES", 1000)
    assert httpx.post(live.url("/v1/decisions"), content=b"x" * 2000, headers=live.bearer).status_code == 413
    path = live.url("/v2/models/direction.step/infer")
    infer = httpx.post(path, content=b"x" * 2000, headers={**live.bearer, "Inference-Header-Content-Length": "9"})
    assert (infer.status_code, "larger than 1000" in infer.json()["error"]) == (413, True)


def test_a_foreign_page_gets_no_websocket_and_an_allowed_one_does(tmp_path: Path, models_folder: Path) -> None:
    with live_service(tmp_path, models_folder, allowed_origins=("https://Cell.example",)) as guarded:
        url = guarded.url("/v1/live", "ws")
        for origin in ("https://evil.example", "null"):
            with pytest.raises(InvalidStatus, match="403"), connect(url, origin=origin):
                pass
        for origin in ("https://cell.example", "https://CELL.example"):
            with connect(url, origin=origin) as link:
                assert link.recv(20)
        with connect(url, origin=f"http://127.0.0.1:{guarded.port}") as link:
            assert link.recv(20)


def test_a_watching_token_cannot_drive_or_push(tmp_path: Path, models_folder: Path) -> None:
    tokens = {"token_watch": WATCH, "token_drive": DRIVE}
    with live_service(tmp_path, models_folder, **tokens) as guarded:
        path = guarded.url("/v1/insertion", "ws")
        hello = wire.ClientHello(insertion_id="role", client="test").model_dump_json()
        with connect(path, additional_headers={"Authorization": f"Bearer {WATCH}"}) as link:
            link.send(hello)
            assert wire.parse_service(link.recv(20)).code == "forbidden"
        with connect(f"{path}?token={DRIVE}") as link:
            link.send(hello)
            assert wire.parse_service(link.recv(20)).type == "hello"
        with pytest.raises(InvalidStatus), connect(path):
            pass
        push = guarded.url(f"/v1/cameras/left/push?token={WATCH}", "ws")
        with pytest.raises(InvalidStatus), connect(push):
            pass


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    if shutil.which("openssl") is None:
        pytest.skip("no openssl command to make a certificate with")
    folder = tmp_path_factory.mktemp("tls")
    cert, key = folder / "cert.pem", folder / "key.pem"
    command = ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"]
    command += ["-keyout", str(key), "-out", str(cert), "-days", "2", "-subj", "/CN=localhost"]
    subprocess.run([*command, "-addext", "subjectAltName=IP:127.0.0.1"], check=True, capture_output=True)
    return cert, key


def test_tls_carries_requests_and_an_insertion_and_nothing_goes_in_the_clear(
    tmp_path: Path, models_folder: Path, certificate: tuple[Path, Path]
) -> None:
    cert, key = certificate
    trusting = ssl.create_default_context(cafile=str(cert))
    options = {"tls_certificate": cert, "tls_key": key, "host": "0.0.0.0", "token_drive": DRIVE}
    with live_service(tmp_path, models_folder, **options) as guarded:
        bearer = {"Authorization": f"Bearer {DRIVE}"}
        url = guarded.url("/v1/models", "https")
        assert httpx.get(url, headers=bearer, verify=trusting).status_code == 200
        assert httpx.get(url, verify=trusting).status_code == 401
        with pytest.raises(httpx.ConnectError, match="CERTIFICATE_VERIFY_FAILED"):
            httpx.get(url, headers=bearer)
        with pytest.raises(httpx.HTTPError):
            httpx.get(guarded.url("/v1/models"), headers=bearer)
        path = guarded.url("/v1/insertion", "wss")
        with connect(path, ssl=trusting, additional_headers=bearer, compression=None) as link:
            link.send(wire.ClientHello(insertion_id="tls", client="test").model_dump_json())
            assert wire.parse_service(link.recv(20)).type == "hello"


def test_a_service_stops_in_order_while_a_client_over_tls_is_leaving(
    tmp_path: Path, models_folder: Path, certificate: tuple[Path, Path]
) -> None:
    """It has said that it closes, and has not yet closed: over TLS that takes a moment longer."""
    cert, key = certificate
    trusting = ssl.create_default_context(cafile=str(cert))
    with (
        socket.socket() as plain,
        live_service(tmp_path, models_folder, tls_certificate=cert, tls_key=key, token_drive=DRIVE) as guarded,
    ):
        plain.connect(("127.0.0.1", guarded.port))
        plain.settimeout(20.0)
        leaving = trusting.wrap_socket(plain, server_hostname="127.0.0.1")
        asked = f"GET /v1/insertion HTTP/1.1\r\nHost: 127.0.0.1:{guarded.port}\r\nAuthorization: Bearer {DRIVE}\r\n"
        upgrade = "Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
        leaving.sendall(f"{asked}{upgrade}Sec-WebSocket-Key: {'A' * 22}==\r\n\r\n".encode())
        assert leaving.recv(4096).startswith(b"HTTP/1.1 101")
        leaving.sendall(b"\x88\x82" + bytes(4) + (1000).to_bytes(2, "big"))  # a masked close frame
        assert leaving.recv(4096)[:1] == b"\x88", "closed in reply"
        # the service stops here; an exception in its thread fails the test
    leaving.close()


def test_a_tls_connection_that_says_nothing_is_closed_and_the_health_check_speaks_tls(
    tmp_path: Path, models_folder: Path, certificate: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.web.server.HEAD_TIMEOUT_S", 0.5)
    cert, key = certificate
    with live_service(tmp_path, models_folder, tls_certificate=cert, tls_key=key) as guarded:
        with socket.create_connection(("127.0.0.1", guarded.port), 5) as silent:
            assert silent.recv(1) == b""
        check = [sys.executable, "-I", "-S", str(ROOT / "docker" / "healthcheck.py"), str(guarded.port), "/healthz"]
        for certificate_file, code in (("", 1), (str(cert), 0)):
            settings = {"TACTILE_TLS_CERTIFICATE": certificate_file, "TACTILE_HOST": "127.0.0.1"}
            assert subprocess.run(check, env=settings, check=False).returncode == code


def test_the_address_that_is_printed_is_one_also_over_ipv6(tmp_path: Path, models_folder: Path) -> None:
    command = [sys.executable, "-m", "service", "run", "--models", str(models_folder), "--host", "::1", "--port", "0"]
    command += ["--recordings", str(tmp_path / "r"), "--state", str(tmp_path / "state"), "--camera-wait-s", "0"]
    command += ["--camera-left", "push:", "--camera-right", "push:"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        try:
            address = process.stdout.readline().split()[-1]
            assert httpx.get(f"{address}healthz").status_code == 200
        finally:
            process.terminate()


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.20", "cell-pc.local"])
def test_every_public_address_needs_a_token(host: str) -> None:
    cameras = ["--camera-left", "push:", "--camera-right", "push:"]
    with pytest.raises(SettingsError, match="is reachable from outside: set --token-drive"):
        read_settings([*cameras, "--host", host])
    with pytest.raises(SettingsError, match="give both or neither"):
        read_settings([*cameras, "--tls-certificate", "c.pem"])


def test_a_client_that_does_not_read_is_cut_off_and_the_service_goes_on(live: LiveService) -> None:
    """It asks until its answers fill every buffer on their way and the service's queue of 256."""
    listeners_n = len(live.station.hub._listeners)
    head = "GET /v1/insertion HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    name = {"insertion_id": "deaf"}
    beat = Frame(Opcode.TEXT, wire.ClientHeartbeat(count=0, **name).model_dump_json().encode())
    greeting = wire.ClientHello(client="test", role="watch", **name).model_dump_json().encode()
    with socket.create_connection(("127.0.0.1", live.port), 20) as deaf:
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        deaf.sendall(f"{head}Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: {'A' * 22}==\r\n".encode())
        deaf.sendall(f"Authorization: {live.bearer['Authorization']}\r\n\r\n".encode())
        assert deaf.recv(12) == b"HTTP/1.1 101"
        deaf.sendall(Frame(Opcode.TEXT, greeting).serialize(mask=True))
        wait_for(lambda: len(live.station.hub._listeners) > listeners_n)
        deaf.settimeout(0.5)
        with contextlib.suppress(OSError):
            while True:
                deaf.sendall(beat.serialize(mask=True) * 200)
        wait_for(lambda: len(live.station.hub._listeners) == listeners_n, 10.0)  # a ping unanswered cuts off after 20 s
        with connect(live.url("/v1/insertion", "ws"), additional_headers=live.bearer, compression=None) as link:
            link.send(wire.ClientHello(insertion_id="beside-deaf", client="test").model_dump_json())
            assert wire.parse_service(link.recv(20)).type == "hello"
            link.send(wire.Abort(insertion_id="beside-deaf", cause="operator", reason="done").model_dump_json())
            assert wire.parse_service(link.recv(20)).type == "finished"


def test_no_hello_in_time_is_a_fault(live: LiveService, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.web.routes.insertion.HELLO_TIMEOUT_S", 0.1)
    with connect(live.url("/v1/insertion", "ws"), additional_headers=live.bearer, compression=None) as link:
        fault = wire.parse_service(link.recv(20))
        assert "no hello within 0.1 s" in fault.detail
        with pytest.raises(ConnectionClosed):
            link.recv(20)
