"""A finger's camera over HTTP for tests: plays probes on a real socket, stamps its frames, can be cut."""

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import cv2
import numpy as np

from service.contract import Finger
from tests.service import drawn

VARIANTS = 3


@lru_cache(maxsize=1000)
def encoded(finger: Finger, index: int, variant: int, size: tuple[int, int] | None) -> bytes:
    """A frame as JPEG; a camera that repeats a frame bit for bit is taken for frozen, so the noise varies."""
    pixels = (drawn.raw(finger, index, 10, 16) if index >= 0 else drawn.untouched(finger)).copy()
    noise = np.random.default_rng(variant).integers(0, 4, pixels.shape, np.uint8)
    cv2.add(pixels, noise, dst=pixels)
    if size:
        pixels = cv2.resize(pixels, size)
    return cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()


def repeated(jpeg: bytes, sequence: int) -> bytes:
    """The same picture once more, beneath noise that is new."""
    pixels = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    noisy = pixels + np.random.default_rng(sequence).normal(0.0, 2.0, pixels.shape)
    return cv2.imencode(".jpg", noisy.clip(0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()


def black(shape: tuple[int, ...], sequence: int) -> bytes:
    """A picture of a camera whose light is out, with its noise."""
    pixels = np.random.default_rng(sequence).integers(0, 4, shape, np.uint8)
    return cv2.imencode(".jpg", pixels)[1].tobytes()


@contextmanager
def answering(*pieces: bytes, every_s: float = 0.0) -> Iterator[str]:
    """What is no camera, or an odd one: a server that answers one request with these pieces; its URL."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(60.0)

        def serve() -> None:
            link, _ = server.accept()
            with link:
                link.recv(4096)
                for piece in pieces:
                    link.sendall(piece)
                    time.sleep(every_s)

        thread = threading.Thread(target=serve)
        thread.start()
        yield f"http://127.0.0.1:{server.getsockname()[1]}/stream"
        thread.join()


class FakeFinger:
    """Two of these play one cell: ``probe()`` makes the object move and slip some frames from now."""

    def __init__(self, finger: Finger, rate_hz: float = 15.0) -> None:
        self.finger, self.rate_hz = finger, rate_hz
        self.probe_started: float | None = None
        self.connected = True
        self.size: tuple[int, int] | None = None
        self.open = False  # nothing touches the gel
        self.trouble = ""  # "stalled": nothing is sent, "frozen", "repeated", "black", "late"
        self.stop = threading.Event()
        for index in range(25):
            for variant in range(VARIANTS):
                encoded(finger, index, variant, None)  # beforehand: a frame must cost the test's machine little
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                outer.serve(self)

            def log_message(self, *args: Any) -> None:
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.server.daemon_threads = True
        self.thread = threading.Thread(target=self.server.serve_forever, args=(0.02,), daemon=True)
        self.thread.start()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server.server_port}/stream.mjpg"

    def probe(self, started: float) -> None:
        self.probe_started = started

    def index(self) -> int:
        if self.open:
            return -1
        if self.probe_started is None:
            return 0
        return max(0, min(int((time.monotonic() - self.probe_started) * self.rate_hz), 24))

    def serve(self, handler: BaseHTTPRequestHandler) -> None:
        if not self.connected:
            handler.send_error(503)
            return
        handler.send_response(200)
        handler.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        handler.end_headers()
        sequence, last = 0, b""
        try:
            while self.connected and not self.stop.is_set():
                now = time.monotonic()
                due = (int(now * self.rate_hz) + 1) / self.rate_hz
                self.stop.wait(due - now)
                if self.trouble != "repeated":
                    last = encoded(self.finger, self.index(), sequence % VARIANTS, self.size)
                if self.trouble != "stalled":
                    self.part(handler, sequence, last)
                sequence += self.trouble != "frozen"
        except OSError:
            return

    def part(self, handler: BaseHTTPRequestHandler, sequence: int, jpeg: bytes) -> None:
        if self.trouble == "repeated":
            jpeg = repeated(jpeg, sequence)
        if self.trouble == "black":
            jpeg = black(drawn.raw(self.finger, 0, 10, 16).shape, sequence)
        stamp = time.monotonic_ns() - (10**9 if self.trouble == "late" else 0)
        head = (
            f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n"
            f"X-Timestamp: {stamp // 10**9}.{stamp % 10**9:09d}\r\n\r\n"
        )
        handler.wfile.write(head.encode() + jpeg + b"\r\n")

    def close(self) -> None:
        self.stop.set()
        self.connected = False
        self.server.shutdown()
        self.server.server_close()
