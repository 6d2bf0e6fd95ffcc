"""Cameras by their URL: MJPEG over HTTP, a video device, a recording, frames pushed by a client."""

import base64
import contextlib
import http.client
import queue
import re
import select
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import SplitResult, unquote, urlsplit

from service.cameras.capture import CameraError, Capture, Source, capture_ns, now_ns
from service.cameras.recorded import RecordingSource
from service.cameras.silence import check_silence
from service.cameras.v4l2 import V4l2Source, device_of
from service.contract import TactileFrame
from service.contract.refusals import nearest
from service.contract.text import split_address, without_secrets

CONNECT_TIMEOUT_S = 0.6  # with the pause between tries, a returned camera is noticed within 1 s
READ_TIMEOUT_S = 1.0
MAX_JPEG_BYTES = 4 << 20
_LENGTH = re.compile(rb"(?im)^content-length:\s*(\d+)")
_STAMP = re.compile(rb"(?im)^x-timestamp:\s*(\d+)\.(\d{1,9})\s*$")
SCHEMES = ("http:", "v4l2:", "file:", "push:")


class MjpegSource:
    """``multipart/x-mixed-replace`` JPEG parts over HTTP; stamped when the part's header arrives.

    A part's ``X-Timestamp`` (seconds) is used as its capture time if it lies within the last second of this machine's
    monotonic clock: the camera server then runs here and stamps with the same clock. From then on its stamps are
    trusted at any age, because a delayed picture must not pass for a fresh one.

    Without such stamps a picture counts as taken when it arrives, so none that waited may pass for a fresh one either:
    of several complete parts only the newest is yielded. After a silence the pictures may be late from then on, and so
    may those of a stream whose stamps cease: it is lost, and reopened.
    """

    def __init__(self, url: str) -> None:
        self.name = without_secrets(url)
        self._parts = urlsplit(url)

    def frames(self, stop: threading.Event) -> Iterator[Capture]:
        """Connect with a bounded timeout and yield every part."""
        host, port = self._parts.hostname or "", self._parts.port or 80
        connection = http.client.HTTPConnection(host, port, timeout=CONNECT_TIMEOUT_S)
        try:
            path = self._parts.path or "/"
            path = f"{path}?{self._parts.query}" if self._parts.query else path
            connection.request("GET", path, headers=_authorization(self._parts))
            sock = connection.sock  # the response of a stream without a length takes it from the connection
            response = connection.getresponse()
            kind = response.headers.get_content_type()
            if response.status != http.HTTPStatus.OK or not kind.startswith("multipart/"):
                raise CameraError(f"answered {response.status} {kind}, expected 200 multipart/x-mixed-replace")
            boundary = _delimiter(response.headers.get_boundary(""))
            if sock is not None:
                sock.settimeout(READ_TIMEOUT_S)
            yield from self._parse(_Stream(response, sock), boundary, stop)
        finally:
            connection.close()

    def _parse(self, stream: "_Stream", boundary: re.Pattern[bytes], stop: threading.Event) -> Iterator[Capture]:
        stamp_ns, same_clock = now_ns(), False
        while not stop.is_set():
            header_end = stream.held.find(b"\r\n\r\n")
            if header_end < 0:
                if len(stream.held) > MAX_JPEG_BYTES:
                    raise CameraError(f"{MAX_JPEG_BYTES} bytes came without the end of a part's header")
                if not stream.fill():
                    return
                stamp_ns = now_ns()
                continue
            header = bytes(stream.held[:header_end])
            arrived_ns = stamp_ns
            stamp_ns = header_stamp_ns(header, arrived_ns, same_clock=same_clock)
            same_clock = same_clock or stamp_ns != arrived_ns
            del stream.held[: header_end + 4]
            jpeg = _body(stream, _length(header), boundary)
            if jpeg is None:
                return
            if same_clock or not stream.holds_another(boundary):
                stream.silence_matters = not same_clock
                yield Capture(stamp_ns, None, jpeg)
            stamp_ns = now_ns()


class _Stream:
    """The bytes of a response: those that have been read and not yet used, and those to come."""

    def __init__(self, response: http.client.HTTPResponse, sock: socket.socket | None) -> None:
        self.held = bytearray()
        self.silence_matters = False
        self._response, self._sock = response, sock
        self._read_ns = now_ns()

    def fill(self) -> bool:
        """Read more; False at the end. Raises CameraError after a silence since which pictures may be late."""
        data = self._response.read1(1 << 16)
        self.held += data
        last_ns, self._read_ns = self._read_ns, now_ns()
        if self.silence_matters:
            check_silence(last_ns, self._read_ns)
        return bool(data)

    def holds_another(self, boundary: re.Pattern[bytes]) -> bool:
        """Whether the next part has arrived as a whole; reads what waits in the socket."""
        while len(self.held) <= MAX_JPEG_BYTES and self._waits():
            if not self.fill():
                break
        header_end = self.held.find(b"\r\n\r\n")
        if header_end < 0:
            return False
        length = _length(bytes(self.held[:header_end]))
        begin = header_end + 4
        return bool(boundary.search(self.held, begin)) if length is None else len(self.held) >= begin + length

    def _waits(self) -> bool:
        """Whether something waits in the socket, which closes with the response."""
        if self._sock is None or self._sock.fileno() < 0:
            return False
        waiting = select.poll()  # select itself takes no descriptor beyond 1023
        waiting.register(self._sock, select.POLLIN)
        return bool(waiting.poll(0))


def _authorization(url: SplitResult) -> dict[str, str]:
    """The header for the user and the password of an address, if it has them (HTTP's basic authentication)."""
    if url.username is None:
        return {}
    who = f"{unquote(url.username)}:{unquote(url.password or '')}".encode()
    return {"Authorization": f"Basic {base64.b64encode(who).decode()}"}


def _delimiter(boundary: str) -> re.Pattern[bytes]:
    """What ends a part. Some cameras count the dashes, which stand before each boundary, as part of its name."""
    name = boundary.strip("-").encode()
    return re.compile(rb"--+" + re.escape(name) if name else rb"\r\n--+")


def _length(header: bytes) -> int | None:
    length = _LENGTH.search(header)
    return int(length[1]) if length else None


def _body(stream: _Stream, length: int | None, boundary: re.Pattern[bytes]) -> bytes | None:
    """The next part's bytes by its length, or up to the next boundary; None at the end of the stream."""
    while True:
        end = length if length is not None else _start(boundary.search(stream.held))
        if 0 <= end <= len(stream.held):
            body = bytes(stream.held[:end])
            del stream.held[:end]
            return body if length is not None else body.removesuffix(b"\r\n")
        if len(stream.held) > MAX_JPEG_BYTES or end > MAX_JPEG_BYTES:
            raise CameraError(f"a part is larger than {MAX_JPEG_BYTES} bytes")
        if not stream.fill():
            return None


def _start(match: re.Match[bytes] | None) -> int:
    return -1 if match is None else match.start()


def header_stamp_ns(header: bytes, arrived_ns: int, *, same_clock: bool = False) -> int:
    """The capture stamp in a part's header if it can be of this machine's monotonic clock, else its arrival.

    ``same_clock``: earlier stamps of this stream were of this clock, so an old stamp is really old. Raises CameraError
    if there is none any more.
    """
    stamp = _STAMP.search(header)
    if stamp is None:
        if same_clock:
            raise CameraError("a part bears no X-Timestamp, unlike those before: its age is unknown")
        return arrived_ns
    return capture_ns(int(stamp[1]) * 1_000_000_000 + int(stamp[2].ljust(9, b"0")), arrived_ns, same_clock=same_clock)


class PushSource:
    """Frames that a client sends to the service, stamped on arrival; of those that wait, the newest is kept.

    After a silence they may be late from then on: the camera is lost, and its client has to connect again.
    """

    name = "push:"

    def __init__(self) -> None:
        self._queue: queue.Queue[Capture] = queue.Queue(maxsize=1)
        self._pusher = threading.Lock()
        self._pushed_ns: int | None = None
        self._anew = False
        self._silence: CameraError | None = None

    def claim(self) -> bool:
        """Become the only client that pushes; False while there is another."""
        if not self._pusher.acquire(blocking=False):
            return False
        self._anew = True
        return True

    def release(self) -> None:
        self._pusher.release()

    def push(self, frame: TactileFrame) -> None:
        """Offer a frame in place of one that waits; raises CameraError after a silence of the client."""
        capture = Capture(now_ns(), frame.pixels)
        anew, self._anew = self._anew, False
        try:
            check_silence(self._pushed_ns, capture.captured_ns)
        except CameraError as silence:
            if not anew:
                raise
            self._silence = silence
        self._pushed_ns = capture.captured_ns
        with contextlib.suppress(queue.Empty):
            self._queue.get_nowait()
        self._queue.put_nowait(capture)

    def frames(self, stop: threading.Event) -> Iterator[Capture]:
        """Yield pushed frames; raises CameraError at the first one after a silence, which itself shows as a stall.

        The silence is that between pushes, however late they are read here.
        """
        while not stop.is_set():
            try:
                capture = self._queue.get(timeout=0.1)
            except queue.Empty:
                continue
            silence, self._silence = self._silence, None
            if silence is not None:
                raise silence
            yield capture


def open_source(url: str, *, frame_rate_hz: float = 30.0) -> Source:
    """The source a URL names; raises CameraError with the accepted forms otherwise."""
    if url.startswith("http://"):
        _check_address(url)
        return MjpegSource(url)
    if device := device_of(url):
        return V4l2Source(device, frame_rate_hz)
    if url == "push:":
        return PushSource()
    path = Path(url.removeprefix("file:"))
    if url.startswith("file:") or (url and path.exists()):
        return RecordingSource(path)
    hint = nearest(url.split(":", maxsplit=1)[0] + ":", SCHEMES)
    shown = without_secrets(url) if "://" in url else re.sub(r".*:.*@", "...@", url)
    raise CameraError(f"camera {shown!r}: expected http://HOST:PORT/PATH, v4l2:N, file:PATH or push:{hint}")


def _check_address(url: str) -> None:
    """Raise CameraError, which shows no password, for an address that is ambiguous or that no request can hold."""
    shown, parts = without_secrets(url), split_address(url)
    if parts is None:
        raise CameraError(
            f"camera {shown!r}: expected http://USER:PASSWORD@HOST:PORT/PATH; in user and password write / as %2F,"
            " ? as %3F, # as %23, [ as %5B and ] as %5D, and an @ after the host as %40"
        )
    if not parts.hostname:
        raise CameraError(f"camera {shown!r} names no host")
    if re.search(r"[^!-~]", url.rpartition("@")[2]):
        raise CameraError(f"camera {shown!r}: write a space as %20, and other letters than ASCII's as %XX, too")
