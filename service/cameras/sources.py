"""Sources of camera frames: MJPEG over HTTP, V4L2, a recording, frames pushed by a client."""

import http.client
import queue
import re
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import cv2
import numpy as np
from numpy.typing import NDArray

from service.cameras.capture import CameraError, Capture, Source, now_ns
from service.contract import TactileFrame
from service.contract.refusals import nearest

CONNECT_TIMEOUT_S = 0.6  # with the pause between tries, a returned camera is noticed within 1 s
READ_TIMEOUT_S = 1.0
MAX_JPEG_BYTES = 4 << 20
_LENGTH = re.compile(rb"(?im)^content-length:\s*(\d+)")
_STAMP = re.compile(rb"(?im)^x-timestamp:\s*(\d+)\.(\d{1,9})\s*$")
_SAME_CLOCK_NS = 1_000_000_000
SCHEMES = ("http:", "v4l2:", "file:", "push:")
IMAGES = {".png", ".jpg", ".jpeg", ".bmp"}


class MjpegSource:
    """``multipart/x-mixed-replace`` JPEG parts over HTTP; stamped when the part's header arrives.

    A part's ``X-Timestamp`` (seconds) is used as its capture time if it lies within the last second of this machine's
    monotonic clock: the camera server then runs here and stamps with the same clock. From then on its stamps are
    trusted at any age, because a delayed picture must not pass for a fresh one.
    """

    def __init__(self, url: str) -> None:
        self.name = url
        self._parts = urlsplit(url)

    def frames(self, stop: threading.Event) -> Iterator[Capture]:
        """Connect with a bounded timeout and yield every part."""
        host, port = self._parts.hostname or "", self._parts.port or 80
        connection = http.client.HTTPConnection(host, port, timeout=CONNECT_TIMEOUT_S)
        try:
            path = self._parts.path or "/"
            connection.request("GET", f"{path}?{self._parts.query}" if self._parts.query else path)
            response = connection.getresponse()
            kind = response.headers.get_content_type()
            if response.status != http.HTTPStatus.OK or not kind.startswith("multipart/"):
                raise CameraError(f"answered {response.status} {kind}, expected 200 multipart/x-mixed-replace")
            boundary = response.headers.get_boundary("").strip("-").encode()
            if connection.sock is not None:
                connection.sock.settimeout(READ_TIMEOUT_S)
            yield from self._parse(response, b"--" + boundary, stop)
        finally:
            connection.close()

    def _parse(self, response: http.client.HTTPResponse, boundary: bytes, stop: threading.Event) -> Iterator[Capture]:
        buffer = bytearray()
        stamp_ns, same_clock = now_ns(), False
        while not stop.is_set():
            header_end = buffer.find(b"\r\n\r\n")
            if header_end < 0:
                if len(buffer) > MAX_JPEG_BYTES:
                    raise CameraError(f"{MAX_JPEG_BYTES} bytes came without the end of a part's header")
                if not self._fill(response, buffer):
                    return
                stamp_ns = now_ns()
                continue
            header = bytes(buffer[:header_end])
            arrived_ns = stamp_ns
            stamp_ns = header_stamp_ns(header, arrived_ns, same_clock=same_clock)
            same_clock = same_clock or stamp_ns != arrived_ns
            del buffer[: header_end + 4]
            length = _LENGTH.search(header)
            jpeg = self._body(response, buffer, int(length[1]) if length else None, boundary)
            if jpeg is None:
                return
            yield Capture(stamp_ns, None, jpeg)
            stamp_ns = now_ns()

    def _body(
        self, response: http.client.HTTPResponse, buffer: bytearray, length: int | None, boundary: bytes
    ) -> bytes | None:
        """The next part's bytes by its length, or up to the next boundary; None at the end of the stream."""
        while True:
            end = length if length is not None else buffer.find(b"\r\n" + boundary)
            if 0 <= end <= len(buffer):
                body = bytes(buffer[:end])
                del buffer[:end]
                return body
            if len(buffer) > MAX_JPEG_BYTES or end > MAX_JPEG_BYTES:
                raise CameraError(f"a part is larger than {MAX_JPEG_BYTES} bytes")
            if not self._fill(response, buffer):
                return None

    @staticmethod
    def _fill(response: http.client.HTTPResponse, buffer: bytearray) -> bool:
        data = response.read1(1 << 16)
        buffer += data
        return bool(data)


def header_stamp_ns(header: bytes, arrived_ns: int, *, same_clock: bool = False) -> int:
    """The capture stamp in a part's header if it can be of this machine's monotonic clock, else its arrival.

    ``same_clock``: earlier stamps of this stream were of this clock, so an old stamp is really old.
    """
    stamp = _STAMP.search(header.replace(b"\r\n", b"\n"))
    if stamp is None:
        return arrived_ns
    return capture_ns(int(stamp[1]) * 1_000_000_000 + int(stamp[2].ljust(9, b"0")), arrived_ns, same_clock=same_clock)


def capture_ns(stamp_ns: int, arrived_ns: int, *, same_clock: bool) -> int:
    """A camera's own stamp if it can be of this machine's monotonic clock, else the frame's arrival."""
    age_ns = arrived_ns - stamp_ns
    return stamp_ns if age_ns >= 0 and (same_clock or age_ns <= _SAME_CLOCK_NS) else arrived_ns


class V4l2Source:
    """A local video device, read through OpenCV; stamped with the driver's buffer time.

    The driver stamps the beginning or end of a frame's arrival, on the monotonic clock if it states one
    (V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC, as UVC does). A stamp of another clock is replaced by the time of reading.
    """

    def __init__(self, device: int, frame_rate_hz: float) -> None:
        self.name = f"v4l2:{device}"
        self._device, self._frame_rate_hz = device, frame_rate_hz
        # a missing camera is retried four times per second, and OpenCV would warn twice each time
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)

    def frames(self, stop: threading.Event) -> Iterator[Capture]:
        capture = cv2.VideoCapture(self._device, cv2.CAP_V4L2)
        try:
            if not capture.isOpened():
                raise CameraError(f"cannot open /dev/video{self._device}; is it plugged in and free?")
            capture.set(cv2.CAP_PROP_FPS, self._frame_rate_hz)
            capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
            same_clock = False
            while not stop.is_set():
                grabbed, pixels = capture.read()
                if not grabbed:
                    return
                read_ns = now_ns()
                driver_ns = round(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
                stamp_ns = capture_ns(driver_ns, read_ns, same_clock=same_clock)
                same_clock = same_clock or stamp_ns != read_ns
                yield Capture(stamp_ns, np.asarray(pixels, np.uint8))
        finally:
            capture.release()


class RecordingSource:
    """A video file or a folder of images, played in a loop at its own or a given rate."""

    def __init__(self, path: Path, frame_rate_hz: float | None = None) -> None:
        self.name = str(path)
        self._path, self._frame_rate_hz = path, frame_rate_hz
        if not path.exists():
            raise CameraError(f"recording {path} does not exist")

    def frames(self, stop: threading.Event) -> Iterator[Capture]:
        while not stop.is_set():
            played = 0
            due = time.monotonic()
            for pixels, rate_hz in clip_images(self._path):
                due += 1.0 / (self._frame_rate_hz or rate_hz)
                if stop.wait(max(0.0, due - time.monotonic())):
                    return
                played += 1
                yield Capture(now_ns(), pixels)
            if not played:
                raise CameraError(f"{self._path} holds no image that can be read")


def clip_images(path: Path) -> Iterator[tuple[NDArray[np.uint8], float]]:
    """BGR image and frame rate (Hz) of each frame of a video, or of a folder of images by name (30 Hz)."""
    if path.is_dir():
        for file in sorted(child for child in path.iterdir() if child.suffix.lower() in IMAGES):
            image = cv2.imread(str(file))
            if image is not None:
                yield np.asarray(image, np.uint8), 30.0
        return
    capture = cv2.VideoCapture(str(path))
    try:
        rate_hz = capture.get(cv2.CAP_PROP_FPS) or 30.0
        while (read := capture.read())[0]:
            yield np.asarray(read[1], np.uint8), rate_hz
    finally:
        capture.release()


class PushSource:
    """Frames that a client sends to the service; the newest few are kept, stamped on arrival."""

    name = "push:"

    def __init__(self) -> None:
        self._queue: queue.Queue[Capture] = queue.Queue(maxsize=4)
        self._pusher = threading.Lock()

    def claim(self) -> bool:
        """Become the only client that pushes; False while there is another."""
        return self._pusher.acquire(blocking=False)

    def release(self) -> None:
        self._pusher.release()

    def push(self, frame: TactileFrame) -> None:
        """Offer a frame; the oldest waiting one is dropped if the reader is behind."""
        capture = Capture(now_ns(), frame.pixels)
        while True:
            try:
                self._queue.put_nowait(capture)
                return
            except queue.Full:
                try:
                    self._queue.get_nowait()
                except queue.Empty:
                    continue

    def frames(self, stop: threading.Event) -> Iterator[Capture]:
        """Yield pushed frames; never ends by itself (a silent client shows as a stall)."""
        while not stop.is_set():
            try:
                yield self._queue.get(timeout=0.1)
            except queue.Empty:
                continue


def open_source(url: str, *, frame_rate_hz: float = 30.0) -> Source:
    """The source a URL names; raises CameraError with the accepted forms otherwise."""
    if url.startswith("http://"):
        if not urlsplit(url).hostname:
            raise CameraError(f"camera {url!r} names no host")
        return MjpegSource(url)
    if device := re.fullmatch(r"(?:v4l2:|/dev/video)(\d+)", url):
        return V4l2Source(int(device[1]), frame_rate_hz)
    if url == "push:":
        return PushSource()
    path = Path(url.removeprefix("file:"))
    if url.startswith("file:") or (url and path.exists()):
        return RecordingSource(path)
    hint = nearest(url.split(":", maxsplit=1)[0] + ":", SCHEMES)
    raise CameraError(f"camera {url!r}: expected http://HOST:PORT/PATH, v4l2:N, file:PATH or push:{hint}")
