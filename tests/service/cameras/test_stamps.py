"""When a picture was taken: a part's own stamp, or its arrival, but never that of a picture that had waited."""

import contextlib
import os
import resource
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from service.cameras.capture import CameraError
from service.cameras.sources import MjpegSource, _Stream, header_stamp_ns
from tests.service.mjpeg import answering


def test_a_stamp_of_this_machines_clock_is_believed_and_no_other() -> None:
    now = 5_000_000_000_000
    assert header_stamp_ns(b"X-Timestamp: 4999.980000000\r\n", now) == 4_999_980_000_000
    assert header_stamp_ns(b"X-Timestamp: 1700000000.5\r\n", now) == now
    assert header_stamp_ns(b"X-Timestamp: 4000.5\r\n", now) == now
    assert header_stamp_ns(b"Content-Length: 3\r\n", now) == now


class Parts:
    """An answer of parts, each with its stamp in s."""

    def __init__(self, *stamps_s: float) -> None:
        self.parts = [b"--f\r\nX-Timestamp: %.9f\r\nContent-Length: 1\r\n\r\nx\r\n" % stamp_s for stamp_s in stamps_s]

    def read1(self, _size: int) -> bytes:
        return self.parts.pop(0) if self.parts else b""


def test_a_picture_that_was_held_up_for_seconds_does_not_pass_for_a_fresh_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.cameras.sources.now_ns", lambda: 5_000_000_000_000)
    source = MjpegSource("http://127.0.0.1:9/")
    captures = source._parse(_Stream(Parts(4999.98, 4997.5, 4999.99), None), b"--f", threading.Event())
    assert [capture.captured_ns / 1e9 for capture in captures] == pytest.approx([4999.98, 4997.5, 4999.99])
    captures = source._parse(_Stream(Parts(4000.5, 4000.6), None), b"--f", threading.Event())
    assert [capture.captured_ns / 1e9 for capture in captures] == [5000.0, 5000.0], "another machine's clock"


def test_a_stream_whose_stamps_cease_is_reopened(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its later pictures would count as taken when they arrive, however late."""
    monkeypatch.setattr("service.cameras.sources.now_ns", lambda: 5_000_000_000_000)
    parts = Parts(4999.98)
    parts.parts.append(b"--f\r\nContent-Length: 1\r\n\r\nx\r\n")
    captures = MjpegSource("http://127.0.0.1:9/")._parse(_Stream(parts, None), b"--f", threading.Event())
    assert next(captures).captured_ns == 4_999_980_000_000
    with pytest.raises(CameraError, match="no X-Timestamp, unlike those before"):
        next(captures)


@contextmanager
def unstamped_camera(padding_n: int = 0) -> Iterator[tuple[str, Callable[[int], None]]]:
    """A camera on a real socket that gives no stamps: its URL, and a call that sends one part."""
    listening = socket.create_server(("127.0.0.1", 0))
    connections: list[socket.socket] = []

    def accept() -> None:
        connection, _ = listening.accept()
        connection.recv(4096)
        connection.sendall(b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=f\r\n\r\n--f\r\n")
        connections.append(connection)

    def send(k: int) -> None:
        while not connections:
            time.sleep(0.01)
        connections[0].sendall(b"Content-Type: image/jpeg\r\n\r\n%d%s\r\n--f\r\n" % (k, b" " * padding_n))

    thread = threading.Thread(target=accept, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{listening.getsockname()[1]}/", send
    finally:
        thread.join(1)
        for one in (listening, *connections):
            one.close()


@pytest.mark.parametrize("padding_n", [0, 60_000])
def test_pictures_without_stamps_that_waited_are_dropped(padding_n: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Read at once, all are yielded; of those that arrived while nobody read, only the newest, however large."""
    monkeypatch.setattr("service.cameras.silence.SILENT_S", 30.0)  # of a busy machine
    with unstamped_camera(padding_n) as (url, send):
        captures = MjpegSource(url).frames(threading.Event())
        for k in range(3):
            threading.Timer(0.02, send, (k,)).start()
            assert next(captures).jpeg.strip() == b"%d" % k
        for k in range(3, 8):
            send(k)
        assert next(captures).jpeg.strip() == b"7"


def test_a_stream_is_read_beside_a_thousand_connections_and_to_its_end() -> None:
    with contextlib.ExitStack() as others:
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
        others.callback(resource.setrlimit, resource.RLIMIT_NOFILE, (soft, hard))
        for _ in range(1100):
            others.enter_context(Path(os.devnull).open("rb"))
        head = b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=f\r\n\r\n"
        with answering(head, *(b"--f\r\nContent-Length: 1\r\n\r\n%d\r\n" % k for k in range(3))) as url:
            captures = list(MjpegSource(url).frames(threading.Event()))
    assert captures[-1].jpeg == b"2"


def test_after_a_silence_a_stream_without_stamps_is_reopened() -> None:
    """A service that was stopped finds pictures of unknown age, and a camera that was silent may be late from then."""
    with unstamped_camera() as (url, send):
        captures = MjpegSource(url).frames(threading.Event())
        threading.Timer(0.02, send, (0,)).start()
        assert next(captures).jpeg == b"0"
        time.sleep(0.25)
        send(1)
        with pytest.raises(CameraError, match="what waited may be old"):
            next(captures)


@pytest.mark.parametrize(
    ("declared", "delimiter", "before"),
    [
        ("f", b"--f", b"\r\n"),
        ("--f", b"--f", b"\r\n"),
        ("--f", b"----f", b"\r\n"),
        ('"--f"', b"----f", b"\r\n"),
        ("--f--", b"----f--", b"\r\n"),
        ("f", b"--f", b""),
    ],
)
def test_pictures_without_a_length_end_where_the_camera_says(declared: str, delimiter: bytes, before: bytes) -> None:
    """Cameras differ in whether the dashes belong to the boundary that they declare."""
    kind = f"Content-Type: multipart/x-mixed-replace; boundary={declared}"
    head = f"HTTP/1.0 200 OK\r\n{kind}\r\n\r\n".encode()
    parts = [delimiter + b"\r\nContent-Type: image/jpeg\r\n\r\n--%d" % k + before for k in range(3)]
    with answering(head, *parts, delimiter, every_s=0.05) as url:
        captures = list(MjpegSource(url).frames(threading.Event()))
    assert [capture.jpeg for capture in captures] == [b"--0", b"--1", b"--2"]
