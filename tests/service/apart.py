"""A service in a process of its own, and its cameras in this one."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tests.service import drawn
from tests.service.conftest import LiveService
from tests.service.mjpeg import FakeFinger
from tests.service.process import ServiceProcess, service_process

PATIENT = (  # the machine may be busy
    *("--max-frame-age-ms=20000", "--reference-timeout-s=30", "--frames-timeout-s=30"),
    *("--decision-timeout-s=60", "--client-timeout-s=60"),
)


@dataclass
class Apart:
    """What a driver needs of both."""

    service: ServiceProcess
    fingers: tuple[FakeFinger, FakeFinger]

    def url(self, path: str, scheme: str = "http") -> str:
        return self.service.url(path, scheme)

    @property
    def bearer(self) -> dict[str, str]:
        return self.service.bearer

    probe = LiveService.probe


@contextlib.contextmanager
def apart(folder: Path, models: Path, rate_hz: float = 15.0) -> Iterator[Apart]:
    """The service keeps its recordings in ``folder``, in which another may have kept its own before."""
    fingers = FakeFinger("left", rate_hz), FakeFinger("right", rate_hz)
    drawn.calibration().save(folder / "calibration.toml")
    cameras = [f"--camera-{finger.finger}={finger.url}" for finger in fingers]
    options = [*cameras, *PATIENT, f"--calibration={folder / 'calibration.toml'}"]
    try:
        with service_process(models, folder / "recordings", *options) as service:
            yield Apart(service, fingers)
    finally:
        for finger in fingers:
            finger.close()
