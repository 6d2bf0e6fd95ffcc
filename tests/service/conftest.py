import contextlib
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import httpx
import pytest

from service.contract.token import TOKEN_FILE, read_token
from service.session.station import Station, open_station
from service.settings import Settings
from service.web.app import create_app
from service.web.server import bind, web_server
from tests.service import drawn
from tests.service.mjpeg import FakeFinger

rehearsed: set[Path] = set()  # the models that a service of this process has warmed up with


@dataclass
class LiveService:
    """A whole service on a real port, with two cameras on real sockets."""

    station: Station
    fingers: tuple[FakeFinger, FakeFinger]
    port: int
    recordings: Path

    @property
    def token(self) -> str:
        """The token for driving and administration, as a client of this machine finds it."""
        return read_token(self.station.settings.state / TOKEN_FILE)

    @property
    def bearer(self) -> dict[str, str]:
        return bearer(self.station)

    def probe(self, delay_s: float = 0.0) -> None:
        started = time.monotonic() + delay_s
        for finger in self.fingers:
            finger.probe(started)

    def url(self, path: str, scheme: str = "http") -> str:
        return f"{scheme}://127.0.0.1:{self.port}{path}"

    def metrics(self) -> str:
        """The metrics as they are now: the service makes them ten times a second at most."""
        time.sleep(0.11)
        return httpx.get(self.url("/metrics")).text


def bearer(station: Station) -> dict[str, str]:
    """The header that lets a client drive and administer."""
    return {"Authorization": f"Bearer {read_token(station.settings.state / TOKEN_FILE)}"}


@contextlib.contextmanager
def serve(station: Station) -> Iterator[int]:
    sock: socket.socket = bind("127.0.0.1", 0)
    server = web_server(create_app(station), station.settings)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [sock]}, daemon=True)
    thread.start()
    try:
        yield sock.getsockname()[1]
    finally:
        server.should_exit = True
        thread.join(10)
        sock.close()


@contextlib.contextmanager
def served(settings: Settings) -> Iterator[tuple[Station, int]]:
    """A station of these settings, running, and the port it is served on."""
    station = open_station(settings)
    station.start()
    try:
        with serve(station) as port:
            yield station, port
    finally:
        station.stop()


# Tests share their machine with others: nothing they claim is a matter of seconds.
PATIENT = {
    "max_frame_age_ms": 20_000.0,
    "reference_timeout_s": 30.0,
    "frames_timeout_s": 30.0,
    "decision_timeout_s": 60.0,
    "client_timeout_s": 60.0,
}


@contextlib.contextmanager
def live_service(folder: Path, models: Path, **changes: object) -> Iterator[LiveService]:
    fingers = FakeFinger("left"), FakeFinger("right")
    calibration = folder / "calibration.toml"
    drawn.calibration().save(calibration)
    settings = Settings(
        models=models,
        camera_left=fingers[0].url,
        camera_right=fingers[1].url,
        calibration=calibration,
        recordings=folder / "recordings",
        state=folder / "state",
        **PATIENT | changes,
    )
    with pytest.MonkeyPatch.context() as patient:
        patient.setattr("service.cameras.capture.STALL_S", 30.0)
        patient.setattr("service.cameras.sources.READ_TIMEOUT_S", 30.0)
        patient.setattr("service.session.decider.FRESH_S", 20.0)
        patient.setattr("service.session.station.STANDSTILL_S", 30.0)
        patient.setattr("service.cameras.sources.CONNECT_TIMEOUT_S", 10.0)
        for limit in ("SLID_MM", "ALL_LATE_MM", "BLIND_S"):  # a late stop lets the made-up object slide on
            patient.setattr(f"service.decision.claim.{limit}", 1e3)
        patient.setattr("service.decision.held_tilt.SLID_SHARE", 0.0)
        if models in rehearsed:  # a second of each test's time, for the same answer
            patient.setattr("service.session.station.warm_up", lambda *_: None)
        rehearsed.add(models)
        station = open_station(settings)
        station.start()
        try:
            station.wait_for_cameras(60)
            with serve(station) as port:
                yield LiveService(station, fingers, port, settings.recordings)
        finally:
            station.stop()
            for finger in fingers:
                finger.close()


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory, models_folder: Path) -> Iterator[LiveService]:
    with live_service(tmp_path_factory.mktemp("live"), models_folder) as service:
        yield service
