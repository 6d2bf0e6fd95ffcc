"""The two fingers' cameras: one capture thread each, monotonic stamps, explicit faults, pairing by capture time.

A camera is a URL: ``http://host:port/path`` (MJPEG), ``v4l2:0`` or ``/dev/video0``, ``file:clip.mp4`` or a path to a
recording or folder of images (played at its own pace, in a loop), ``push:`` (a client sends the frames).
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
import structlog
from numpy.typing import NDArray

from service.contract import ContractError, Finger, FramePair, TactileFrame
from service.contract.frames import FINGERS
from service.contract.wire import CameraEntry, FaultCode
from service.contract.wire_parts import CameraState

RETRY_S = 0.25  # a returned camera is noticed within 1 s
STALL_S = 0.5  # no frame for this long is a stall
GLANCE_EVERY = 4  # without attention one frame in this many is decoded; the others only show that the camera lives
MAX_BROKEN = 10  # consecutive undecodable JPEGs before the camera is reopened
WAITING_N = 8  # frames that wait for the other finger's: 90 ms at 90 frames a second
_SAME_CLOCK_NS = 1_000_000_000
log = structlog.get_logger()


class CameraError(ContractError):
    """A camera cannot be read; the text names it and what was expected."""


@dataclass(frozen=True, slots=True)
class Capture:
    """A captured frame: monotonic stamp, pixels uint8 [h, w, 3] BGR or the JPEG that still holds them."""

    captured_ns: int
    pixels: NDArray[np.uint8] | None
    jpeg: bytes = b""

    def image(self) -> NDArray[np.uint8]:
        """The pixels, decoded if necessary; raises CameraError if the JPEG is broken."""
        return decode_jpeg(self.jpeg) if self.pixels is None else self.pixels


class Source(Protocol):
    """Source of frames. ``frames`` yields until the camera ends or fails (raises OSError or CameraError)."""

    name: str

    def frames(self, stop: threading.Event) -> Iterator[Capture]:
        """Connect and yield frames; returns when ``stop`` is set."""


def decode_jpeg(jpeg: bytes) -> NDArray[np.uint8]:
    """BGR pixels of one JPEG; raises CameraError if it is broken."""
    pixels = decoded(np.frombuffer(jpeg, np.uint8))
    if pixels is None:
        raise CameraError(f"{len(jpeg)} bytes are not a JPEG image")
    return pixels


def decoded(encoded: NDArray[np.uint8]) -> NDArray[np.uint8] | None:
    """The BGR picture in the bytes of a file; None if they hold none, or if its stated size is too large for one."""
    try:
        image = cv2.imdecode(encoded, cv2.IMREAD_COLOR) if encoded.size else None
    except cv2.error:
        return None
    return None if image is None else np.asarray(image, np.uint8)


@dataclass(frozen=True, slots=True)
class CameraFrame:
    """A frame with its original JPEG, so that recording and streaming need no second encoding."""

    frame: TactileFrame
    jpeg: bytes | None


class Camera:
    """One finger's camera: a thread that captures, stamps, counts, notices stalls and size changes, and reconnects.

    ``on_frame`` is called in the capture thread for each frame, ``on_fault(finger, code, detail)`` once per change into
    a bad state; codes are camera_lost, camera_stalled, camera_frozen, camera_size. ``refuses`` says why pictures of a
    shape [h, w, 3] are of no use; a camera that delivers such is lost, with that detail.

    A picture that repeats the last one bit for bit is not new, since every camera has noise: it is counted but not
    passed on, and half a second of nothing else is a frozen camera. While ``attended`` is False, most JPEGs are counted
    but not decoded, which saves three quarters of an idle service's load.
    """

    def __init__(
        self,
        finger: Finger,
        source: Source,
        on_frame: Callable[[CameraFrame], None],
        on_fault: Callable[[Finger, FaultCode, str], None],
        attended: Callable[[], bool] = lambda: True,
        refuses: Callable[[tuple[int, ...]], str | None] = lambda _: None,
    ) -> None:
        self.finger = finger
        self.source = source
        self.state: CameraState = "starting"
        self.latest: CameraFrame | None = None
        self.newest_ns: int | None = None
        self.frames_n = 0
        self._broken_n = self._skipped_n = self._same_n = self._checked_n = self._checked_ns = 0
        self._picture: bytes | NDArray[np.uint8] = b""
        self.shape: tuple[int, ...] | None = None
        self.last_fault = ""
        self._on_frame, self._on_fault, self._attended, self._refuses = on_frame, on_fault, attended, refuses
        self._stamps: deque[int] = deque(maxlen=31)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"camera-{finger}", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        """End the capture thread; waits at most 2 s for a source that blocks."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(2.0)

    @property
    def frame_rate_hz(self) -> float | None:
        """Rate measured over about the last second, None before the second frame."""
        stamps = list(self._stamps)
        if len(stamps) < 2 or stamps[-1] == stamps[0]:
            return None
        return (len(stamps) - 1) * 1e9 / (stamps[-1] - stamps[0])

    @property
    def entry(self) -> CameraEntry:
        return CameraEntry(
            finger=self.finger, source=self.source.name, state=self.state, frame_rate_hz=self.frame_rate_hz
        )

    def check_stall(self, now_ns: int) -> None:
        """Mark a live camera without frames as stalled; its owner calls this a few times per second."""
        came_n = self.frames_n - self._checked_n
        self._checked_n, self._checked_ns = self.frames_n, now_ns
        if not (self.state == "live" and self.newest_ns and now_ns - self.newest_ns > STALL_S * 1e9):
            return
        if self._same_n:
            detail = f"the same picture {self._same_n + 1} times for {STALL_S:g} s from {self.source.name}"
            self._fault("stalled", "camera_frozen", detail)
        elif came_n:
            age_s = (now_ns - self.newest_ns) / 1e9
            self._fault("stalled", "camera_stalled", f"pictures from {self.source.name} arrive {age_s:.1f} s late")
        else:
            self._fault("stalled", "camera_stalled", f"no frame for {STALL_S:g} s from {self.source.name}")

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                for capture in self.source.frames(self._stop):
                    self._publish(capture)
                detail = f"{self.source.name} ended"
            except Exception as error:
                detail = f"{self.source.name}: {str(error) or type(error).__name__}"
            if not self._stop.is_set():
                self._fault("lost", "camera_lost", detail)
                self._stop.wait(RETRY_S)

    def _publish(self, capture: Capture) -> None:
        if self.newest_ns is not None and capture.captured_ns <= self.newest_ns:
            return
        if self._repeats(capture):
            self._same_n += 1
            return
        self._same_n = 0
        if capture.pixels is None and self._may_skip():
            self._skipped_n += 1
            self._count(capture.captured_ns)
            return
        pixels = self._decoded(capture)
        if pixels is None:
            return
        self._skipped_n = 0
        was, self.shape = self.shape, pixels.shape
        if refused := self._refuses(pixels.shape):
            if (self.state, self.last_fault) != ("lost", refused):
                self._fault("lost", "camera_size", refused)
            return
        if was is not None and was != self.shape and not self._refuses(was):
            self._fault("lost", "camera_size", f"{self.finger} frames changed from {_size(was)} to {_size(self.shape)}")
        seq = self.latest.frame.seq + 1 if self.latest else 0
        frame = CameraFrame(TactileFrame(self.finger, seq, capture.captured_ns, pixels), capture.jpeg or None)
        self.latest = frame
        self._count(capture.captured_ns)
        self._on_frame(frame)

    def _repeats(self, capture: Capture) -> bool:
        """Whether this picture repeats the last one."""
        last, picture = self._picture, capture.jpeg if capture.pixels is None else capture.pixels
        self._picture = picture
        if isinstance(picture, bytes) or isinstance(last, bytes):
            return isinstance(picture, bytes) and isinstance(last, bytes) and picture == last
        return bool(np.array_equal(picture, last))

    def _may_skip(self) -> bool:
        return self.state == "live" and self._skipped_n < GLANCE_EVERY - 1 and not self._attended()

    def _count(self, captured_ns: int) -> None:
        self.newest_ns = captured_ns
        self.frames_n += 1
        self._stamps.append(captured_ns)
        if self.state == "stalled" and self._checked_ns - captured_ns > STALL_S * 1e9:
            return  # as old as those that were called stalled
        if self.state in {"stalled", "lost"}:
            log.info("camera", finger=self.finger, code="live_again")
        self.state = "live"

    def _decoded(self, capture: Capture) -> NDArray[np.uint8] | None:
        """The pixels, or None for a broken JPEG; raises CameraError at MAX_BROKEN in a row."""
        try:
            pixels = capture.image()
        except CameraError:
            self._broken_n += 1
            if self._broken_n >= MAX_BROKEN:
                self._broken_n = 0
                raise
            return None
        self._broken_n = 0
        return pixels

    def _fault(self, state: CameraState, code: FaultCode, detail: str) -> None:
        changed = self.state != state or code == "camera_size"
        self.state, self.last_fault = state, detail
        self._stamps.clear()
        if changed:
            self._on_fault(self.finger, code, detail)


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[1]} x {shape[0]}"


def frame_age_ms(cameras: Iterable[Camera], at_ns: int) -> float | None:
    """Age of the newest frame of the camera that is further behind, None before each has one."""
    newest = [camera.newest_ns for camera in cameras]
    known = [stamp_ns for stamp_ns in newest if stamp_ns is not None]
    return (at_ns - min(known)) / 1e6 if len(known) == len(newest) else None


class Pairer:
    """Pairs the two fingers' frames by capture time: each frame is used once, skew is bounded, newest wins.

    Thread safe. The allowed skew is 0.6 of the slower camera's frame period. A camera whose pictures arrive several
    periods after the other's still finds the frames that were taken with its own.
    """

    def __init__(self) -> None:
        self._waiting: dict[Finger, deque[TactileFrame]] = {name: deque(maxlen=WAITING_N) for name in FINGERS}
        self._last: dict[Finger, int] = {}
        self._period_ns: dict[Finger, float] = {}
        self._lock = threading.Lock()
        self.dropped_n = 0

    def add(self, frame: TactileFrame) -> FramePair | None:
        """Add a frame; returns the pair that it completes."""
        with self._lock:
            self._measure(frame)
            mine = self._waiting[frame.finger]
            others = self._waiting["right" if frame.finger == "left" else "left"]
            allowed_ns = 0.6 * max(self._period_ns.values(), default=33e6)
            fits = (one for one in reversed(others) if abs(frame.captured_ns - one.captured_ns) <= allowed_ns)
            if (partner := next(fits, None)) is None:
                self.dropped_n += len(mine) == WAITING_N
                mine.append(frame)
                return None
            while others.popleft() is not partner:
                self.dropped_n += 1
            self.dropped_n += len(mine)
            mine.clear()
            return FramePair(frame, partner) if frame.finger == "left" else FramePair(partner, frame)

    def _measure(self, frame: TactileFrame) -> None:
        last = self._last.get(frame.finger)
        self._last[frame.finger] = frame.captured_ns
        if last is not None and 0 < frame.captured_ns - last < 0.2e9:
            period = float(frame.captured_ns - last)
            self._period_ns[frame.finger] = 0.9 * self._period_ns.get(frame.finger, period) + 0.1 * period


def now_ns() -> int:
    """The clock of all stamps in this process and on this machine."""
    return time.monotonic_ns()


def capture_ns(stamp_ns: int, arrived_ns: int, *, same_clock: bool) -> int:
    """A camera's own stamp if it can be of this machine's monotonic clock, else the frame's arrival."""
    age_ns = arrived_ns - stamp_ns
    return stamp_ns if age_ns >= 0 and (same_clock or age_ns <= _SAME_CLOCK_NS) else arrived_ns
