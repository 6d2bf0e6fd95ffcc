"""A manager of insertions without threads of its own, and clients that drive it."""

import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from service.cameras.capture import CameraFrame
from service.contract import FINGERS, Finger, TactileFrame, wire
from service.decision.models import ModelSet
from service.observability.hub import Hub
from service.session.manager import InsertionManager
from service.settings import Settings
from tests.service import drawn


def arm(insertion_id: str = "one", **stated: Any) -> wire.Arm:
    return wire.Arm(insertion_id=insertion_id, attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0, **stated)


def camera(finger: Finger, size: tuple[int, int]) -> SimpleNamespace:
    """A camera that has delivered one frame of ``size`` (width, height)."""
    pixels = np.zeros((size[1], size[0], 3), np.uint8)
    entry = wire.CameraEntry(finger=finger, source="x", state="live", frame_rate_hz=30.0)
    return SimpleNamespace(latest=CameraFrame(TactileFrame(finger, 0, 1, pixels), None), newest_ns=1, entry=entry)


def manager(models: ModelSet, folder: Path, size: tuple[int, int] = (427, 320)) -> InsertionManager:
    calibration = folder / "calibration.toml"
    drawn.calibration().save(calibration)
    settings = Settings(
        models=folder, camera_left="push:", camera_right="push:", recordings=folder / "r", calibration=calibration
    )
    cameras = {finger: camera(finger, size) for finger in FINGERS}
    return InsertionManager(settings, models, drawn.calibration(), cameras, Hub(), lambda _: None)


class Client:
    """The driving end of a connection."""

    def __init__(self, manager: InsertionManager) -> None:
        self.manager = manager
        self.heard: list[wire.ServiceMessage] = []

    def send(self, message: wire.ServiceMessage) -> None:
        self.heard.append(message)

    def connect(self, insertion_id: str = "one") -> wire.ServiceMessage:
        self.manager.connect(wire.ClientHello(insertion_id=insertion_id, client="test"), self.send)
        return self.heard[-1]


class Cell:
    """A manager with its hub's events, and a client that drives."""

    def __init__(self, folder: Path, models: ModelSet, **settings: Any) -> None:
        usual = {"models": folder, "camera_left": "push:", "camera_right": "push:", "recordings": folder / "r"}
        entry = wire.CameraEntry(finger="left", source="x", state="live", frame_rate_hz=30.0)
        cameras: Any = {finger: SimpleNamespace(latest=None, entry=entry) for finger in FINGERS}
        self.events: list[tuple[str, Any]] = []
        hub = Hub()
        hub.subscribe(lambda kind, content: self.events.append((kind, content)))
        (folder / "r").mkdir(exist_ok=True)
        self.manager = InsertionManager(Settings(**usual | settings), models, None, cameras, hub, lambda _: None)
        self.client = Client(self.manager)

    def ends(self, insertion_id: str, *messages: Any, **hello: Any) -> Client:
        """An insertion that is opened and aborted after these messages; its client."""
        client = Client(self.manager)
        self.manager.connect(wire.ClientHello(insertion_id=insertion_id, client="test", **hello), client.send)
        for message in messages:
            self.manager.receive(message, client.send)
        self.manager.abort("operator", "done")
        wait_for_recorders()
        return client

    @property
    def kinds(self) -> list[str]:
        return [kind for kind, _ in self.events]


def wait_for_recorders() -> None:
    for thread in threading.enumerate():
        if thread.name in {"recorder", "close-recording"}:
            thread.join(60)
            assert not thread.is_alive()
