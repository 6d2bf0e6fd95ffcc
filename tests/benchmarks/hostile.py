"""`python -m tests.benchmarks.hostile` (`make bench-hostile`): what a flood costs the robot, and the service in memory.

Rows: age of what slip is judged on, at the client, with two cameras at 90 fps, alone and beside 20 pages and a flood of
inference; memory, health and the robot's greeting beside 64 hostile bodies and 2,000 idle connections. Writes
docs/hostile_load.json, from which `section` makes a table.
"""

import argparse
import contextlib
import json
import os
import resource
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
from websockets.sync.client import connect

from reporting.machine import machine
from reporting.statistics import percentiles
from reporting.table import table
from service.contract import wire
from tests.benchmarks.load import _infer, _look, busy_service
from tests.benchmarks.serving_report import REACHED, Row
from tests.service.process import ServiceProcess, service_process

INFER = "/v2/models/direction.step/infer"
MOST_MB, MOST_AGE_MS, PAGES = 400, 60, 20
RATE_HZ, BODIES, IDLE = 90.0, 64, 2000
NO_CAMERAS = ["--camera-left", "push:", "--camera-right", "push:", "--camera-wait-s", "0", "--requests-per-s", "0"]


def greeted_s(service: ServiceProcess) -> float:
    """How long health checks and the greeting of the robot's client take together; raises if one is not answered."""
    begun = time.monotonic()
    assert httpx.get(service.url("/healthz"), timeout=10).status_code == 200
    assert "tactile_ready" in httpx.get(service.url("/metrics"), timeout=10).text
    path = service.url("/v1/insertion", "ws")
    with connect(path, additional_headers=service.bearer, compression=None, open_timeout=10) as link:
        name = f"robot-{time.monotonic_ns()}"
        link.send(wire.ClientHello(insertion_id=name, client="robot").model_dump_json())
        assert wire.parse_service(link.recv(20)).type == "hello"
        taken = time.monotonic() - begun
        link.send(wire.Abort(insertion_id=name, cause="operator", reason="done").model_dump_json())
        assert wire.parse_service(link.recv(20)).type == "finished"
    return taken


@contextlib.contextmanager
def most_mb(service: ServiceProcess) -> Iterator[list[float]]:
    """The largest resident memory within the context, sampled fifty times per second."""
    most, stop = [0.0], threading.Event()

    def look() -> None:
        while not stop.wait(0.02):
            most[0] = max(most[0], service.memory_mb()["all"])

    watcher = threading.Thread(target=look)
    watcher.start()
    try:
        yield most
    finally:
        stop.set()
        watcher.join()


def head(service: ServiceProcess, path: str, *lines: str) -> bytes:
    """A request with a valid token: admission costs more than a refusal."""
    token = f"Authorization: Bearer {service.token}"
    return "\r\n".join([f"POST {path} HTTP/1.1", "Host: localhost", token, *lines, "", ""]).encode()


def bodies(service: ServiceProcess) -> dict[str, Any]:
    """Bodies as large as they may be, half of them JSON that grows thirty times, all at once."""
    piece, answers = b"[],[" * (1 << 18), []

    def send(number: int) -> None:
        size = (31 << 20) if number % 2 else (6 << 20)
        lines = [f"Content-Length: {size}", *(["Inference-Header-Content-Length: 8"] if number % 2 else [])]
        with socket.create_connection(("127.0.0.1", service.port), 30) as link, contextlib.suppress(OSError):
            link.sendall(head(service, INFER, *lines))
            for _ in range(size // len(piece)):
                link.sendall(piece)
            answers.append(int(link.recv(4096).split(b" ")[1]))

    senders = [threading.Thread(target=send, args=(number,)) for number in range(BODIES)]
    with most_mb(service) as most:
        for sender in senders:
            sender.start()
        greeted = greeted_s(service)
        for sender in senders:
            sender.join(60)
    return {"n": BODIES, "most_mb": round(most[0]), "greeted_s": round(greeted, 2), "answers": sorted(set(answers))}


def idle(service: ServiceProcess, request: bytes = b"") -> dict[str, Any]:
    """Connections that send ``said`` and nothing more; the robot's client connects now and then, and after the last."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, max(soft, 4096)), hard))
    greeted = []
    with most_mb(service) as most, contextlib.ExitStack() as stack:
        for number in range(IDLE):
            link = stack.enter_context(socket.create_connection(("127.0.0.1", service.port), 20))
            with contextlib.suppress(OSError):
                link.sendall(request)
            if number % 500 == 300:
                greeted.append(greeted_s(service))
        greeted.append(greeted_s(service))
    return {"n": IDLE, "most_mb": round(most[0]), "greeted_s": round(max(greeted), 2)}


def ages_ms(models: Path, seconds: float, *, flooded: bool) -> dict[str, Any]:
    """Capture to `watching` at the client: so old is the newest picture that anybody looked at for slip."""
    stop, ages = threading.Event(), []
    with busy_service(models, RATE_HZ) as (service, _, link), contextlib.ExitStack() as stack:
        pages = [
            stack.enter_context(connect(service.url("/v1/live", "ws"), compression=None, max_size=None))
            for _ in range(PAGES if flooded else 0)
        ]
        works = [threading.Thread(target=_look, args=(page, stop), daemon=True) for page in pages]
        works += [threading.Thread(target=_infer, args=(service, stop), daemon=True)] if flooded else []
        for work in works:
            work.start()
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            message = wire.parse_service(link.recv(20))
            if isinstance(message, wire.Watching):
                ages.append((time.monotonic_ns() - message.frame_captured_ns) / 1e6)
        stop.set()
        for work in works:
            work.join(10)
    p50, p99 = percentiles(ages, 50, 99)
    facts = {"p50_ms": round(p50, 1), "p99_ms": round(p99, 1), "most_ms": round(max(ages), 1), "n": len(ages)}
    return facts | {"pages": len(pages), "judged_per_s": round(len(ages) / seconds, 1)}


def rows(facts: dict[str, Any]) -> list[Row]:
    """Measurements beside their targets."""
    made: list[Row] = []
    for name, what in (("ages alone", "alone"), ("ages flooded", f"{PAGES} pages and a flood of inference")):
        if figures := facts.get(name):
            measured = f"{figures['p50_ms']:.0f} / {figures['p99_ms']:.0f} ms (n = {figures['n']})"
            reached = figures["p99_ms"] <= MOST_AGE_MS
            label = f"age of the newest judged frame, 2 x {RATE_HZ:.0f} fps, {what}: p50 / p99"
            made.append(Row(label, measured, f"p99 {MOST_AGE_MS} ms", reached, figures["load"]))
    for name, what in (("bodies", "hostile bodies at once"), ("idle", "idle connections")):
        if figures := facts.get(name):
            measured = f"{figures['most_mb']} MB, greeted in {figures['greeted_s']:.1f} s"
            reached = figures["most_mb"] < MOST_MB
            label = f"{figures['n']:,} {what}: memory; health and the robot's greeting"
            made.append(Row(label, measured, f"{MOST_MB} MB, answered", reached, figures["load"]))
    return made


def section(facts: dict[str, Any]) -> str:
    """The table of a flood's cost, for a page."""
    columns = (("quantity", "quantity"), ("measured", "measured"), ("at least", "target"))
    return table(rows(facts), *columns, ("reached", lambda row: REACHED[row.reached]), ("load", "load", ".1f"))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", type=Path, default=Path("models"))
    parser.add_argument("--seconds", type=float, default=30.0, help="of each measurement of ages")
    parser.add_argument("--out", type=Path, default=Path("docs/hostile_load.json"))
    options = parser.parse_args()
    parts: dict[str, Callable[[], dict[str, Any]]] = {
        "ages alone": lambda: ages_ms(options.models, options.seconds, flooded=False),
        "ages flooded": lambda: ages_ms(options.models, options.seconds, flooded=True),
    }
    facts: dict[str, Any] = {"machine": machine()}
    for name, measure in parts.items():
        facts[name] = measure() | {"load": round(os.getloadavg()[0], 1)}
        print(name, json.dumps(facts[name]), flush=True)
    with (
        tempfile.TemporaryDirectory() as folder,
        service_process(options.models, Path(folder) / "recordings", *NO_CAMERAS) as service,
    ):
        for name, flood in (("bodies", bodies), ("idle", idle)):
            facts[name] = flood(service) | {"load": round(os.getloadavg()[0], 1)}
            print(name, json.dumps(facts[name]), flush=True)
    options.out.write_text(json.dumps(facts, indent=1) + "\n")
    print(section(facts))
    return 0 if all(row.reached for row in rows(facts)) else 1


if __name__ == "__main__":
    threading.excepthook = lambda _: None  # cameras whose service ended
    sys.exit(main())
