"""A cell for benchmarks: shows a service the pictures of a probe, one at a time, and plays the robot client."""

import contextlib
import queue
import time
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Self

from websockets.sync.client import ClientConnection, connect

from service.cameras.capture import decode_jpeg
from service.contract import FINGERS, Finger, FramePair, TactileFrame, wire
from service.decision.models import ModelSet
from service.session.factory import make_session
from tests.service import drawn
from tests.service.mjpeg import VARIANTS, FakeFinger, encoded
from tests.service.process import ServiceProcess

PERIOD_S = 1 / 30
IDLE_S = 0.15
LAST = 17  # number of the eighth frame of the decision: motion begins at 10


def jpeg(finger: Finger, index: int, variant: int) -> bytes:
    """A picture of the probe; what follows its end makes it another one; the noise has a few variants."""
    return encoded(finger, index, variant % VARIANTS, None) + variant.to_bytes(4, "little")


def in_process_ms(models: ModelSet) -> float:
    """One attempt in lock step at the cameras' pace: from the last pair's JPEGs to the correction's text."""
    session = make_session(models, drawn.calibration())
    session.handle(wire.ClientHello(insertion_id="b", client="bench"), 0)
    for finger in FINGERS:
        session.prime(TactileFrame(finger, 0, 0, decode_jpeg(jpeg(finger, 0, 0))))
    session.handle(wire.Arm(insertion_id="b", attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0), 10)

    def feed(index: int) -> list[str]:
        stamp = 11 + int(index * PERIOD_S * 1e9)
        frames = [TactileFrame(f, index + 1, stamp, decode_jpeg(jpeg(f, index, index))) for f in FINGERS]
        replies = [reply for frame in frames for reply in session.on_frame(frame, stamp)]
        replies += session.on_pair(FramePair(*frames), stamp)
        return [reply.model_dump_json() for reply in replies]

    for index in range(LAST):
        feed(index)
        time.sleep(PERIOD_S)
    stopped = wire.Stopped(insertion_id="b", attempt=1, depth_mm=6.0, outcome="blocked")
    session.handle(stopped, int(LAST * PERIOD_S * 1e9))
    time.sleep(PERIOD_S)
    started = time.perf_counter()
    lines = feed(LAST)
    taken = (time.perf_counter() - started) * 1e3
    if not any('"correction"' in line for line in lines):
        raise RuntimeError(f"no correction but {lines}")
    return taken


class SteppedFinger(FakeFinger):
    """A camera over HTTP that shows a picture exactly on request."""

    def __init__(self, finger: Finger) -> None:
        self.pictures: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self.shown, self.again, self.index_shown = jpeg(finger, 0, 0), 0, 0
        self.left_ns = 0  # when the picture that it was asked to show began to leave
        super().__init__(finger)

    def serve(self, handler: BaseHTTPRequestHandler) -> None:
        handler.send_response(200)
        handler.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        handler.end_headers()
        with contextlib.suppress(OSError):
            while picture := self.next_picture():
                stamp = time.monotonic_ns()
                if picture is self.shown:
                    self.left_ns = stamp
                head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(picture)}\r\n"
                head += f"X-Timestamp: {stamp // 10**9}.{stamp % 10**9:09d}\r\n\r\n"
                handler.wfile.write(head.encode() + picture + b"\r\n")

    def next_picture(self) -> bytes:
        """The requested picture; without a request for a while, the last picture again, so that it stays live."""
        with contextlib.suppress(queue.Empty):
            self.shown = self.pictures.get(timeout=IDLE_S)
            return self.shown
        self.again += 1
        return jpeg(self.finger, self.index_shown, self.again) if self.shown else b""

    def close(self) -> None:
        self.pictures.put(b"")
        super().close()


@dataclass
class SteppedCell:
    """Two stepped cameras in front of a service, and insertions over its WebSocket."""

    fingers: dict[str, SteppedFinger] = field(default_factory=lambda: {f: SteppedFinger(f) for f in FINGERS})
    service: ServiceProcess | None = None
    seq: int = 0
    done: int = 0

    def __enter__(self) -> Self:
        self.show(0)
        return self

    def __exit__(self, *_: object) -> None:
        for finger in self.fingers.values():
            finger.close()

    def options(self, folder: Path) -> list[str]:
        """Of a service in front of these cameras."""
        drawn.calibration().save(folder / "calibration.toml")
        cameras = [f"--camera-{name}={finger.url}" for name, finger in self.fingers.items()]
        patient = ["--max-frame-age-ms", "60000", "--frames-timeout-s", "20", "--client-timeout-s", "60"]
        return [*cameras, "--calibration", str(folder / "calibration.toml"), "--reference-timeout-s", "20", *patient]

    def show(self, index: int) -> None:
        self.seq += 1
        for name, finger in self.fingers.items():
            finger.index_shown = index
            finger.pictures.put(jpeg(name, index, self.seq))

    def decision_ms(self) -> float:
        """One insertion: from the moment the last pair begins to leave its cameras to the correction in hand."""
        self.done += 1
        name = f"bench-{self.done}-{time.monotonic_ns()}"
        self.show(0)
        url = self.service.url("/v1/insertion", "ws")
        with connect(url, additional_headers=self.service.bearer, compression=None) as link:
            link.send(wire.ClientHello(insertion_id=name, client="bench", purpose="probe").model_dump_json())
            self._until(link, "hello")
            arm = wire.Arm(insertion_id=name, attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0)
            link.send(arm.model_dump_json())
            self._arm(link)
            for index in range(1, LAST):
                self.show(index)
                time.sleep(PERIOD_S)
            stopped = wire.Stopped(insertion_id=name, attempt=1, depth_mm=6.0, outcome="blocked")
            link.send(stopped.model_dump_json())
            time.sleep(2 * PERIOD_S)
            self.show(LAST)
            answer = self._until(link, "correction", "no_decision")
            taken = (time.monotonic_ns() - max(finger.left_ns for finger in self.fingers.values())) / 1e6
            link.send(wire.Abort(insertion_id=name, cause="operator", reason="done").model_dump_json())
            self._until(link, "finished")
        if answer.type != "correction":
            raise RuntimeError(f"no correction but {answer.reason}: {answer.detail}")
        return taken

    def _arm(self, link: ClientConnection) -> None:
        for _ in range(60):
            self.show(0)
            with contextlib.suppress(TimeoutError):
                while wire.parse_service(link.recv(PERIOD_S)).type != "armed":
                    pass
                return
        raise RuntimeError("the service did not arm")

    def _until(self, link: ClientConnection, *kinds: str) -> object:
        while (message := wire.parse_service(link.recv(60))).type not in kinds:
            pass
        return message
