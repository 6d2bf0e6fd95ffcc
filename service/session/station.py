"""The station: cameras, models and the insertion under way, each in its own thread.

Threads: one per camera (capture, decode, rectify), ``perception`` (the session: slip path, state machine),
``networks``, one recorder per insertion. The event loop of the web server only passes messages on. All work on the
session is posted as callables to the perception thread's inbox; camera frames wait in a short queue where the newest
win.
"""

import contextlib
import queue
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import IO, Any

from service.cameras.capture import Camera, CameraError, CameraFrame, Pairer, frame_age_ms, now_ns
from service.cameras.sources import PushSource, open_source
from service.contract import FINGERS, ContractError, Finger, FramePair, wire
from service.decision.models import ModelSet, load_models
from service.decision.work import Work
from service.observability.hub import Hub
from service.perception.identity import gel_names
from service.perception.rectification import Calibration
from service.recordings.listing import endings
from service.recordings.recovery import own, recover
from service.session.factory import make_session
from service.session.insertion import Insertion, Send
from service.session.manager import REMEMBERED_N, InsertionManager
from service.session.warm_up import warm_up
from service.settings import Settings
from service.versions.versions import Versions

BACKLOG_FRAMES = 8  # about 4 frames of each finger; older ones are dropped
RECENT_N = 16  # frames per finger whose JPEG is available when they form a pair
PERIOD_NS = 33_000_000  # of a camera with an unknown rate
TICK_S = 0.05
STANDSTILL_S = 5.0  # no call may take as long: a driving client hears nothing meanwhile, and holds after 0.75 s


@dataclass(slots=True)
class Counters:
    """Counts of the station since its start."""

    frames_dropped_n: int = 0
    perception_errors_n: int = 0


class Station:
    """Owns the hardware side of the service; ``start`` it, ``stop`` it. Public methods are thread safe."""

    def __init__(self, settings: Settings, models: ModelSet, calibration: Calibration | None) -> None:
        self.settings = settings
        self.hub = Hub()
        self.counters = Counters()
        self.pairer = Pairer()
        self.expected_hz = settings.frame_rate_hz or models.card.profile.fps
        urls = {"left": settings.camera_left, "right": settings.camera_right}
        self.cameras: dict[Finger, Camera] = {
            finger: Camera(
                finger,
                open_source(urls[finger], frame_rate_hz=self.expected_hz),
                self._on_camera_frame,
                self._on_camera_fault,
                self._attends,
                partial(self._size_fault, finger),
            )
            for finger in FINGERS
        }
        self.viewers_n = 0
        self.owned: IO[bytes] | None = None  # the lock of the recordings
        self._frames: deque[tuple[CameraFrame, FramePair | None]] = deque()
        self._inbox: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._networks = ThreadPoolExecutor(1, "networks")  # slip detection never waits for a network
        self.versions = Versions(settings.state / "versions", models, self.hub.publish, gel_names(calibration))
        self.manager = InsertionManager(
            settings, self.versions.active, calibration, self.cameras, self.hub, self._submit, self.versions
        )
        self._ticked_ns = now_ns()
        self._thread = threading.Thread(target=self._run, name="perception", daemon=True)

    # ---- life ------------------------------------------------------------------------------------------------------

    def start(self) -> None:
        self._thread.start()
        for camera in self.cameras.values():
            camera.start()

    def wait_for_cameras(self, timeout_s: float) -> None:
        """Wait for a first frame of each finger and check its size; raise CameraError with the remedy."""
        deadline = now_ns() + int(timeout_s * 1e9)
        while any(camera.latest is None for camera in self.cameras.values()):
            for finger, camera in self.cameras.items():
                if camera.shape and (fault := self._size_fault(finger, camera.shape)):
                    raise CameraError(fault)
            if now_ns() > deadline:
                break
            threading.Event().wait(0.02)
        frames = [camera.latest.frame for camera in self.cameras.values() if camera.latest]
        warm_up(make_session(self.models, self.manager.calibration), frames)

    def _size_fault(self, finger: Finger, shape: tuple[int, ...]) -> str | None:
        """Why pictures of this size are of no use, None if they can be raw or rectified."""
        accepted = [self.models.card.frame.shape]
        calibration = self.manager.calibration
        if calibration:
            accepted.append(calibration.camera(finger).raw.shape)
        if shape in accepted:
            return None
        sizes = " or ".join(f"{width} x {height}" for height, width, _ in accepted)
        hint = "set the camera to it" if calibration else "raw frames need --calibration FILE (service calibrate)"
        return f"{finger} camera delivers {shape[1]} x {shape[0]} frames, expected {sizes}; {hint}"

    def stop(self) -> None:
        """Abort a running insertion, close its recording, end all threads."""
        self.post(lambda: self.manager.abort("service", "service stops"))
        self._inbox.put(None)
        self._thread.join(10.0)
        if self.manager.closing:  # before the locks are given up
            self.manager.closing.join()
        for camera in self.cameras.values():
            camera.stop()
        self._networks.shutdown()
        self.versions.close()
        if self.owned is not None:
            self.owned.close()

    @property
    def models(self) -> ModelSet:
        """The networks that decide the insertion under way, else the next one."""
        return self.manager.models if self.active else self.versions.active

    @property
    def active(self) -> Insertion | None:
        return self.manager.active

    @property
    def ready(self) -> bool:
        """Models warm, both cameras live, and the perception thread at work."""
        return not self.standstill and all(camera.state == "live" for camera in self.cameras.values())

    @property
    def standstill(self) -> str:
        """For how long the perception thread has done nothing, as while a disk that hangs opens a recording; or ""."""
        silent_s = (now_ns() - self._ticked_ns) * 1e-9
        return f"no frame is judged and no client answered for {silent_s:.0f} s" if silent_s > STANDSTILL_S else ""

    # ---- inbox -----------------------------------------------------------------------------------------------------

    def post(self, call: Callable[[], None]) -> None:
        """Run a callable in the perception thread."""
        self._inbox.put(call)

    def _run(self) -> None:
        while True:
            try:
                call = self._inbox.get(timeout=TICK_S)
            except queue.Empty:
                call = self._tick
            if call is None:
                return
            self._try(call)
            self._try(self._tick_if_due)  # a client that sends all the time must not keep deadlines from being checked

    def _try(self, call: Callable[[], None]) -> None:
        try:
            call()
        except Exception as error:
            self._failed(f"{type(error).__name__}: {error}")

    def _failed(self, detail: str) -> None:
        """Handle an exception of a call: the client must hold, and this thread must go on."""
        self.counters.perception_errors_n += 1
        with contextlib.suppress(Exception):
            self.hub.publish("error", detail)
            self.manager.fault("internal", detail)

    def _tick(self) -> None:
        now = self._ticked_ns = now_ns()
        for camera in self.cameras.values():
            camera.check_stall(now)
        self.manager.tick(now)

    def _submit(self, work: Work) -> None:
        """Do network work in its own thread, in order; its result comes back through the inbox."""
        self._networks.submit(self._do, work)

    def _do(self, work: Work) -> None:
        if (result := work.run()) is not None:
            self.post(lambda: self.manager.result(result))

    # ---- cameras ---------------------------------------------------------------------------------------------------

    def _attends(self) -> bool:
        return self.active is not None or self.viewers_n > 0

    def _on_camera_frame(self, frame: CameraFrame) -> None:
        if self.active:
            seq = frame.frame.seq
            self.manager.jpegs[frame.frame.finger, seq] = frame.jpeg
            self.manager.jpegs.pop((frame.frame.finger, seq - RECENT_N), None)
            self._frames.append((frame, self.pairer.add(frame.frame)))
            self.post(self._next_frame)
        self.hub.frame(frame)

    def _next_frame(self) -> None:
        while len(self._frames) > BACKLOG_FRAMES or self._is_outdated():
            self._frames.popleft()
            self.counters.frames_dropped_n += bool(self.active and self.active.wants_frames)
        if not self._frames:
            return
        frame, pair = self._frames.popleft()
        if self.active and self.active.wants_frames:
            self.active.frame(frame, pair)

    def _is_outdated(self) -> bool:
        """Whether slip is watched and the oldest waiting frame is older than a frame period, with a newer one waiting.

        Slip is thus detected on frames no older than a frame period and a step, however slow this machine is. At
        standstill nothing is urgent, and every frame helps the decision.
        """
        if len(self._frames) <= len(FINGERS) or not (self.active and self.active.session.watches_slip):
            return False
        oldest = self._frames[0][0].frame
        rate_hz = self.cameras[oldest.finger].frame_rate_hz
        return now_ns() - oldest.captured_ns > (1e9 / rate_hz if rate_hz else PERIOD_NS)

    def _tick_if_due(self) -> None:
        if now_ns() - self._ticked_ns > TICK_S * 1e9:
            self._tick()

    def _on_camera_fault(self, finger: Finger, code: wire.FaultCode, detail: str) -> None:
        self.hub.publish("camera_fault", {"finger": finger, "code": code, "detail": detail})
        self.post(lambda: self.manager.fault(code, detail))

    def push(self, finger: Finger) -> PushSource:
        """The source for a client's pushed frames; raises ContractError if this finger has its own camera."""
        source = self.cameras[finger].source
        if not isinstance(source, PushSource):
            raise ContractError(f"the {finger} camera is {source.name}; start the service with --camera-{finger} push:")
        return source

    def camera_entries(self) -> tuple[wire.CameraEntry, ...]:
        return self.manager.camera_entries()

    def frame_age_ms(self) -> float | None:
        """Age of the newest frame of the older finger, None before the first."""
        return frame_age_ms(self.cameras.values(), now_ns())

    # ---- clients ---------------------------------------------------------------------------------------------------

    def connect(self, hello: wire.ClientHello, send: Send) -> None:
        """Connect a client that wants to drive (see :meth:`InsertionManager.connect`)."""
        self.post(lambda: self.manager.connect(hello, send))

    def receive(self, message: Any, send: Send) -> None:
        self.post(lambda: self.manager.receive(message, send))

    def disconnect(self, send: Send) -> None:
        self.post(lambda: self.manager.disconnect(send))


def open_station(settings: Settings) -> Station:
    """Load and check everything a station needs; raise ContractError or OSError with one clear line."""
    models = load_models(settings.models)
    calibration = Calibration.load(settings.calibration) if settings.calibration else None
    if calibration and (why := calibration.unlike(models.card)):
        raise ContractError(f"{settings.calibration} {why}")
    owned = own(settings.recordings)
    recover(settings.recordings)
    station = Station(settings, models, calibration)
    station.owned = owned
    station.manager.ended.update((one.insertion_id, one) for one in endings(settings.recordings, REMEMBERED_N))
    if settings.shadow:
        station.versions.give(settings.shadow, at_start=True)
    return station
