"""Faults of a cell's network and disk, injected for the soak; bounded, on loopback."""

import contextlib
import random
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable

import httpx
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

from tests.service.mjpeg import FakeFinger
from tests.service.process import ServiceProcess

SOCKETS = ("/", "/v1/insertion", "/v1/live", "/v1/cameras/left/frames", "/v1/cameras/left/push", "/nowhere")
PATHS = ("/v1/models", "/v1/recordings/x", "/v1/decisions", "/v2/models/direction.step/infer", "/v2/repository/index")
LINK = {"compression": None, "open_timeout": 20}
EXPECTED = (OSError, WebSocketException, httpx.HTTPError, EOFError)


class Trouble:
    """A thread that injects one kind of fault about every ``every_s`` until ``stop`` is set, and counts them."""

    def __init__(self, every_s: float, seed: int, make: Callable[[random.Random], str]) -> None:
        self.done: Counter[str] = Counter()
        self.errors: list[str] = []
        self._every_s, self._make, self._random = every_s, make, random.Random(seed)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(self._every_s * self._random.uniform(0.5, 1.5)):
            try:
                self.done[self._make(self._random)] += 1
            except AssertionError as error:
                self.errors.append(str(error))
            except EXPECTED as error:
                self.done[f"answered by {type(error).__name__}"] += 1

    def close(self) -> None:
        self._stop.set()
        self._thread.join(30)


class Garbage:
    """Nonsense on the service's port: bytes, half requests, bodies, and every WebSocket."""

    def __init__(self, service: ServiceProcess) -> None:
        self.service = service
        self._open: list[socket.socket] = []

    def __call__(self, rng: random.Random) -> str:
        kind = rng.choice((self.noise, self.half_a_request, self.body, self.talk, self.talk))
        kind(rng)
        return kind.__name__.replace("_", " ")

    def close(self) -> None:
        """Close the half requests."""
        for link in self._open:
            link.close()

    def _bearer(self, rng: random.Random) -> dict[str, str] | None:
        """The token, three times out of four: authorised requests must survive garbage, too."""
        return self.service.bearer if rng.random() < 0.75 else None

    def noise(self, rng: random.Random) -> None:
        with socket.create_connection(("127.0.0.1", self.service.port), 5) as link:
            link.sendall(rng.randbytes(rng.randrange(1, 5000)))
            link.settimeout(0.2)
            with contextlib.suppress(TimeoutError):
                link.recv(4096)

    def half_a_request(self, rng: random.Random) -> None:
        link = socket.create_connection(("127.0.0.1", self.service.port), 5)
        link.sendall(
            b"POST /v1/decisions HTTP/1.1\r\nHost: localhost\r\nContent-Length: 100" + b"\r\n\r\nabc" * rng.randrange(2)
        )
        self._open.append(link)
        while len(self._open) > 8:
            self._open.pop(0).close()

    def body(self, rng: random.Random) -> None:
        length = rng.randrange(2000)
        headers = self._bearer(rng) or {}
        headers |= {"Inference-Header-Content-Length": str(rng.randrange(3000))} if rng.random() < 0.5 else {}
        headers |= {"Content-Encoding": rng.choice(("gzip", "deflate", "br"))} if rng.random() < 0.3 else {}
        method = rng.choice(("GET", "POST", "DELETE", "PUT"))
        answer = httpx.request(
            method, self.service.url(rng.choice(PATHS)), content=rng.randbytes(length), headers=headers, timeout=30
        )
        assert answer.status_code < 500, f"{method} {answer.url} answered {answer.status_code}: {answer.text[:200]}"

    def talk(self, rng: random.Random) -> None:
        with connect(self.service.url(rng.choice(SOCKETS), "ws"), additional_headers=self._bearer(rng), **LINK) as link:
            for _ in range(rng.randrange(1, 6)):
                link.send(rng.choice((rng.randbytes(rng.randrange(300)), "{" * rng.randrange(50), "x" * 100_000)))
                with contextlib.suppress(TimeoutError):
                    link.recv(0.05)


class Cuts:
    """Disconnects a camera for a moment."""

    def __init__(self, fingers: tuple[FakeFinger, FakeFinger]) -> None:
        self.fingers = fingers

    def __call__(self, rng: random.Random) -> str:
        finger = rng.choice(self.fingers)
        finger.connected = False
        time.sleep(rng.uniform(0.1, 1.5))
        finger.connected = True
        return f"{finger.finger} camera cut"


def server_errors(service: ServiceProcess) -> list[str]:
    """Lines of the service's log with an unexpected exception."""
    log = service.log
    return ["".join(log[i : i + 60]) for i, line in enumerate(log) if "Traceback" in line or '"level": "error"' in line]
