"""The controller that docs/api.md teaches, and a cell for it: the real service as a process, with two cameras."""

import importlib.util
import json
import sys
import time
from pathlib import Path

import httpx

from tests.examples.tiny_arm import TinyArm
from tests.service import drawn
from tests.service.mjpeg import FakeFinger
from tests.service.process import ServiceProcess, service_process
from tests.waiting import wait_for

EXAMPLE = Path(__file__).parents[2] / "examples" / "cell_controller.py"
spec = importlib.util.spec_from_file_location("cell_controller", EXAMPLE)
controller = importlib.util.module_from_spec(spec)
sys.modules["cell_controller"] = controller
spec.loader.exec_module(controller)

BOUND_MM = 1.5
SLOW_MM_S = 2.0  # this machine is shared: a lease of 0.7 s outlasts its pauses, and the bound stays the same
NUMBERS = iter(range(1000))


class Cell:
    """A service with two cameras, and one insertion of the example's in it."""

    def __init__(self, service: ServiceProcess, fingers: tuple[FakeFinger, FakeFinger]) -> None:
        self.service, self.fingers = service, fingers

    def insert(
        self, arm: TinyArm, port: int | None = None, token: str | None = None, name: str | None = None, **fields
    ) -> dict:
        named = name or f"box-{next(NUMBERS)}"
        task = controller.Task(
            **{"name": named, "gap_width_mm": 56.0, "depth_mm": 4.0, "speed_mm_s": SLOW_MM_S, **fields}
        )
        self.open_hand(True)
        arm.on_grasp = lambda: self.open_hand(False)
        url = f"ws://127.0.0.1:{port or self.service.port}/v1/insertion"
        return controller.insert(arm, self.service.token if token is None else token, task, url)

    def open_hand(self, is_open: bool) -> None:
        for finger in self.fingers:
            finger.open = is_open

    def touch(self) -> None:
        for finger in self.fingers:
            finger.probe(time.monotonic() - 0.6)  # it begins to move at once, and slips within a millimetre

    def rest(self) -> None:
        heal(self.fingers)
        wait_for(lambda: httpx.get(self.service.url("/readyz"), timeout=10).status_code == 200)
        wait_for(lambda: httpx.get(self.service.url("/v1/insertions"), timeout=10).json()["active"] is None)

    def outcome(self, name: str) -> tuple[str, str | None]:
        """Outcome of an insertion by the service's own record."""
        summary = self.summary(name)
        return summary["outcome"], summary["cause"]

    def summary(self, name: str) -> dict:
        path, *_ = wait_for(lambda: list(self.service.recordings.glob(f"*{name}*/summary.json")))
        return json.loads(path.read_text())


def heal(fingers: tuple[FakeFinger, FakeFinger]) -> None:
    for finger in fingers:
        finger.probe_started, finger.trouble, finger.connected = None, "", True


def started(folder: Path, models_folder: Path, fingers: tuple[FakeFinger, FakeFinger]):
    calibration = folder / "calibration.toml"
    drawn.calibration().save(calibration)
    cameras = ("--camera-left", fingers[0].url, "--camera-right", fingers[1].url)
    options = (*cameras, "--calibration", str(calibration), "--client-timeout-s", "3")
    return service_process(models_folder, folder / "recordings", *options)


def stands(arm: TinyArm) -> None:
    """The arm stands, went no further than the bound after the fault, and goes nowhere any more."""
    assert arm.stopped
    assert not arm.descending()
    depth_mm = arm.depth_mm()
    if arm.broken_mm is not None:
        assert depth_mm - arm.broken_mm <= BOUND_MM
    time.sleep(0.1)
    assert arm.depth_mm() == depth_mm
    assert not arm.moves
