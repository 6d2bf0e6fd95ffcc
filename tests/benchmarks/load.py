"""Loads for the serving benchmark: fast cameras, everything at once, and more frames than can be perceived."""

import contextlib
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from numpy.typing import NDArray
from websockets.sync.client import ClientConnection, connect

from service.contract import wire
from service.decision.models import load_models
from service.session.station import Station
from service.settings import Settings
from tests.benchmarks.crowd import crowd
from tests.service import drawn
from tests.service.mjpeg import FakeFinger
from tests.service.process import ServiceProcess, service_process

WITHIN_33_MS = 'tactile_result_age_seconds_bucket{le="0.033"}'
PATIENT = ["--max-frame-age-ms", "60000", "--reference-timeout-s", "30", "--client-timeout-s", "600"]


@contextlib.contextmanager
def busy_service(
    models: Path, rate_hz: float
) -> Iterator[tuple[ServiceProcess, tuple[FakeFinger, FakeFinger], ClientConnection]]:
    """A service with two MJPEG cameras at 427 x 320 and an armed attempt, so that every frame is perceived.

    The connection that drives must be read: it gets a message for each pair.
    """
    fingers = FakeFinger("left", rate_hz), FakeFinger("right", rate_hz)
    with tempfile.TemporaryDirectory() as folder:
        calibration = Path(folder) / "calibration.toml"
        drawn.calibration().save(calibration)
        cameras = ["--camera-left", fingers[0].url, "--camera-right", fingers[1].url]
        options = [*cameras, "--calibration", str(calibration), "--frame-rate-hz", str(rate_hz), *PATIENT]
        with service_process(models, Path(folder) / "r", *options) as service, armed(service) as link:
            yield service, fingers, link
    for finger in fingers:
        finger.close()


@contextlib.contextmanager
def armed(service: ServiceProcess) -> Iterator[ClientConnection]:
    with connect(service.url("/v1/insertion", "ws"), additional_headers=service.bearer, compression=None) as link:
        name = f"load-{time.monotonic_ns()}"
        link.send(wire.ClientHello(insertion_id=name, client="bench", purpose="probe").model_dump_json())
        arm = wire.Arm(insertion_id=name, attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0)
        link.send(arm.model_dump_json())
        while wire.parse_service(link.recv(60)).type != "armed":
            pass
        yield link
        link.send(wire.Abort(insertion_id=name, cause="operator", reason="done").model_dump_json())
        with contextlib.suppress(TimeoutError):
            link.recv(5)


@contextlib.contextmanager
def reading(link: ClientConnection) -> Iterator[None]:
    """Read and discard a connection's data within the context: if unread, the service would close it."""
    stop = threading.Event()
    reader = threading.Thread(target=_look, args=(link, stop), daemon=True)
    reader.start()
    try:
        yield
    finally:
        stop.set()
        reader.join(10)


def metric(service: ServiceProcess, name: str) -> float:
    lines = httpx.get(service.url("/metrics"), timeout=60).text.splitlines()
    return sum(float(line.rsplit(" ", 1)[1]) for line in lines if line.startswith(name))


def flood(models: Path, rate_hz: float, seconds: float) -> dict[str, Any]:
    """CPU of the whole service (cameras, perception, recording) while every frame of both fingers is perceived."""
    with busy_service(models, rate_hz) as (service, _, link), reading(link):
        time.sleep(2.0)
        names = ("tactile_frames_total", "tactile_frames_dropped", 'tactile_stage_seconds_count{stage="markers"}')
        before, cpu, started = [metric(service, name) for name in names], service.cpu_s(), time.monotonic()
        time.sleep(seconds)
        wall = time.monotonic() - started
        used = service.cpu_s() - cpu
        frames, dropped, perceived = (metric(service, n) - b for n, b in zip(names, before, strict=True))
    return {
        "asked_hz": rate_hz,
        "camera_frames_per_s": round(frames / wall, 1),
        "perceived_per_s": round(perceived / wall, 1),
        "dropped_share": round(dropped / max(frames, 1), 4),
        "cores": round(used / wall, 3),
        "cpu_ms_per_frame": round(1e3 * used / max(perceived, 1), 2),
        "cores_at_full_rate": round(2 * rate_hz * used / max(perceived, 1), 3),
    }


def cells(models: Path, count: int, rate_hz: float, seconds: float) -> dict[str, Any]:
    """As many cells on this machine, each a service with two cameras and an attempt under way: what each takes.

    ``share_within_33_ms`` is of the slip judgements, from the capture of their frame; a recording grows by ``pair_kb``
    with every pair of frames.
    """
    counted = 'tactile_stage_seconds_count{stage="markers"}', "tactile_result_age_seconds_count", WITHIN_33_MS
    with contextlib.ExitStack() as stack:
        services = []
        for _ in range(count):
            service, _, link = stack.enter_context(busy_service(models, rate_hz))
            stack.enter_context(reading(link))
            services.append(service)
        time.sleep(2.0)

        def state() -> NDArray[np.float64]:
            return np.array([[s.cpu_s(), _recorded_kb(s), *(metric(s, name) for name in counted)] for s in services])

        before, started = state(), time.monotonic()
        time.sleep(seconds)
        grown, wall = state() - before, time.monotonic() - started
        resident = [service.memory_mb()["all"] for service in services]
    cpu_s, written_kb, perceived, answered, soon = grown.sum(0)
    return {
        "cells_n": count,
        "asked_hz": rate_hz,
        "cores_a_cell": round(float(cpu_s) / wall / count, 3),
        "perceived_share": round(float(perceived) / (2 * rate_hz * wall * count), 3),
        "memory_mb_a_cell": round(float(np.mean(resident)), 1),
        "share_within_33_ms": round(float(soon / answered), 4),
        "pair_kb": round(float(2 * written_kb / perceived), 1),
    }


def _recorded_kb(service: ServiceProcess) -> float:
    return sum(file.stat().st_size for file in service.recordings.rglob("*") if file.is_file()) / 1e3


def healthz_ms(models: Path, seconds: float) -> dict[str, Any]:
    """/healthz while cameras run at 2 x 60 fps, an attempt is watched, inference is asked for and viewers look on."""
    watched = ("/v1/live", "/v1/cameras/left/frames?max_hz=60", "/v1/cameras/right/frames?form=jpeg")
    with (
        busy_service(models, 60.0) as (service, _, link),
        reading(link),
        crowd(service, watched) as load,
        idle_server() as idle,
    ):
        times: dict[str, list[float]] = {service.url("/healthz"): [], idle: []}
        until = time.monotonic() + seconds
        with httpx.Client(timeout=60) as client:
            while time.monotonic() < until:
                for url, taken in times.items():
                    started = time.perf_counter()
                    client.get(url).raise_for_status()
                    taken.append((time.perf_counter() - started) * 1e3)
                    time.sleep(0.01)
    ours, theirs = times.values()
    p50, p99 = np.percentile(ours, (50, 99))
    idle_p99 = round(float(np.percentile(theirs, 99)), 2)
    latencies = {"p50_ms": round(p50, 2), "p99_ms": round(p99, 2), "most_ms": round(max(ours), 2), "n": len(ours)}
    return latencies | load | {"idle_server_p99_ms": idle_p99, "idle_server_most_ms": round(max(theirs), 2)}


IDLE_SERVER = """
import http.server
class Answer(http.server.BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    def do_GET(self):
        self.send_response(200); self.send_header("Content-Length", "0"); self.end_headers()
    def log_message(self, *_): pass
server = http.server.HTTPServer(("127.0.0.1", 0), Answer)
print(server.server_port, flush=True)
server.serve_forever()
"""


@contextlib.contextmanager
def idle_server() -> Iterator[str]:
    """A process that only answers: its cost is the machine's."""
    with subprocess.Popen([sys.executable, "-c", IDLE_SERVER], stdout=subprocess.PIPE, text=True) as process:
        try:
            yield f"http://127.0.0.1:{int(process.stdout.readline())}/"
        finally:
            process.kill()


def _look(viewer: ClientConnection, stop: threading.Event) -> None:
    with contextlib.suppress(Exception):
        while not stop.is_set():
            viewer.recv(5)


def overload(models: Path) -> dict[str, Any]:
    """Frames at twice the rate that this machine perceives: how old is what slip is judged on?

    The station's own threads and queue run; only the cameras are driven from here, so that "twice" is known.
    """
    from tests.benchmarks.overload import age_at_twice_the_load

    settings = Settings(models=models, camera_left="push:", camera_right="push:", recordings=Path(tempfile.mkdtemp()))
    settings = settings.model_copy(update={"reference_timeout_s": 30.0, "max_frame_age_ms": 60_000.0})
    station = Station(settings, load_models(models), None)
    station.start()
    try:
        return age_at_twice_the_load(station)
    finally:
        station.stop()
