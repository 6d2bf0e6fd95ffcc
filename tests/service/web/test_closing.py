"""However a conversation ends, the client gets the reason, and no client can block on unread data."""

import contextlib
import json
import socket
from pathlib import Path

import pytest
import structlog
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from service.contract import wire
from tests.service.client import Driver, greeted
from tests.service.conftest import LiveService, live_service
from tests.waiting import wait_for


def goodbye(link: ClientConnection) -> tuple[int, str]:
    with contextlib.suppress(ConnectionClosed):
        while True:
            link.recv(20)
    with pytest.raises(ConnectionClosed) as closed:
        link.recv(20)
    assert closed.value.rcvd is not None
    return closed.value.rcvd.code, closed.value.rcvd.reason


def first_words(live: LiveService, text: str | bytes) -> tuple[int, str]:
    with connect(live.url("/v1/insertion", "ws"), additional_headers=live.bearer, compression=None) as link:
        link.send(text)
        return goodbye(link)


def test_every_end_of_a_driving_connection_has_a_reason_and_a_line_in_the_log(live: LiveService) -> None:
    with structlog.testing.capture_logs() as lines:
        driver = greeted(live, "ends")
        busy = first_words(live, wire.ClientHello(insertion_id="other", client="x").model_dump_json())
        driver.insert(1)
        ends = [
            goodbye(driver.socket),
            busy,
            first_words(live, "what?"),
            first_words(live, b"bytes"),
            first_words(live, wire.ClientHeartbeat(insertion_id="h", count=1).model_dump_json()),
            first_words(live, wire.ClientHello(insertion_id="old", client="x", protocol=99).model_dump_json()),
            first_words(live, '{"type": "hello", "insertion_id": "new", "protocol": 3, "asks": "what this cannot"}'),
            first_words(live, '{"type": "hello", "insertion_id": "new", "protocol": 3, "role": "watch"}'),
            first_words(live, wire.ClientHello(insertion_id="ends", client="again").model_dump_json()),
        ]
    expected = [
        (1000, "insertion inserted"),
        (1013, "busy: insertion ends is under way"),
        (1008, "bad_message: "),
        (1008, "bad_message: binary frame"),
        (1008, "bad_message: first message is heartbeat, expected hello"),
        (1008, "protocol_version: client speaks protocol 99"),
        (1008, "protocol_version: client speaks protocol 3, this service 2"),
        (1008, "protocol_version: client speaks protocol 3, this service 2"),
        (1000, "insertion inserted"),
    ]
    for (code, reason), (closed_with, because) in zip(expected, ends, strict=True):
        assert closed_with == code
        assert because.startswith(reason)
    logged = {(line["code"], line["reason"]) for line in lines if line["event"] == "client gone"}
    assert {(code, reason) for code, reason in ends} <= {(code, reason[:123]) for code, reason in logged}


def test_a_service_that_stops_says_so_by_the_code(tmp_path: Path, models_folder: Path) -> None:
    with live_service(tmp_path, models_folder) as stopping:
        driver = greeted(stopping, "left-alone")
    assert goodbye(driver.socket)[0] == 1012


def test_who_asks_again_after_a_restart_is_told_how_the_insertion_ended(tmp_path: Path, models_folder: Path) -> None:
    """It cannot know that the service was restarted, and must not go on with what a new one knows nothing of."""
    with live_service(tmp_path, models_folder) as first:
        driver = Driver(first, "whole")
        finished = driver.insert(1)
        driver.close()
        driver = greeted(first, "broken-off")
    summary = next(tmp_path.glob("recordings/*_broken-off/summary.json"))
    summary.write_text(
        json.dumps({"insertion_id": "broken-off", "outcome": "interrupted", "attempts": 2, "cause": "service"})
    )
    next(tmp_path.glob("recordings/*_whole")).with_name("20260101T000000_odd").mkdir()
    odd = {"insertion_id": "odd", "outcome": "as another release says", "attempts": 1}
    (tmp_path / "recordings" / "20260101T000000_odd" / "summary.json").write_text(json.dumps(odd))
    with live_service(tmp_path, models_folder) as restarted:
        assert Driver(restarted, "whole").receive() == finished
        broken = Driver(restarted, "broken-off").receive()
        assert (broken.type, broken.outcome, broken.cause, broken.attempts) == ("finished", "failed", "service", 2)
        assert restarted.station.active is None


def test_a_client_of_another_protocol_opens_no_insertion(live: LiveService) -> None:
    before = live.station.manager.opened_n, sorted(live.recordings.iterdir())
    first_words(live, wire.ClientHello(insertion_id="older", client="x", protocol=99).model_dump_json())
    assert (live.station.manager.opened_n, sorted(live.recordings.iterdir())) == before
    assert live.station.active is None


def test_a_fault_inside_the_service_is_told_and_logged(live: LiveService, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(live.station, "connect", broken)
    with structlog.testing.capture_logs() as lines:
        hello = wire.ClientHello(insertion_id="broken", client="x").model_dump_json()
        assert first_words(live, hello) == (1011, "internal error: ZeroDivisionError")
    assert [line["log_level"] for line in lines if line["event"] == "connection broke"] == ["error"]


def test_a_listener_that_fails_is_counted_and_breaks_no_insertion(live: LiveService) -> None:
    def broken(kind: str, _: object) -> None:
        if kind == "message":
            raise ZeroDivisionError

    remove = live.station.hub.subscribe(broken)
    try:
        driver = greeted(live, "watched-badly")
        assert driver.insert(1).outcome == "inserted"
        driver.close()
    finally:
        remove()
    assert live.station.hub.errors_n >= 3
    metric = f'tactile_internal_errors{{where="listener"}} {float(live.station.hub.errors_n)}'
    assert metric in live.metrics()
    live.station.hub.errors_n = 0


UPGRADE = "GET {} HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
UPGRADE += "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n"
PLAIN = "GET {} HTTP/1.1\r\nHost: localhost\r\n\r\n"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("request_text", "path"),
    [(UPGRADE, "/v1/cameras/left/frames?max_hz=240"), (PLAIN, "/v1/cameras/left/stream.mjpg?max_hz=240")],
)
def test_a_viewer_that_does_not_read_is_let_go(
    live: LiveService, monkeypatch: pytest.MonkeyPatch, request_text: str, path: str
) -> None:
    monkeypatch.setattr("service.web.server.READ_TIMEOUT_S", 0.2)
    monkeypatch.setattr(live.fingers[0], "rate_hz", 200.0)
    with socket.socket() as link:
        link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        link.connect(("127.0.0.1", live.port))
        link.sendall(request_text.format(path).encode())
        wait_for(lambda: live.station.viewers_n == 1)
        wait_for(lambda: live.station.viewers_n == 0)
