"""`python -m tests.benchmarks.hostile` (`make bench-hostile`): what a flood costs the robot, and the service in memory.

Rows: age of what slip is judged on, at the client, with two cameras at 90 fps, alone and beside 20 pages and a flood of
inference; memory, health and the robot's greeting beside 64 hostile bodies and 2,000 idle connections. Writes
docs/hostile_load.md and .json. It fails if a target is missed, or if the load it measures under was not there.
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
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
from websockets.sync.client import connect

from reporting.machine import machine
from reporting.page import page, publish
from reporting.statistics import percentiles
from reporting.table import Table, table
from service.contract import wire
from tests.benchmarks.crowd import crowd, deciding
from tests.benchmarks.load import busy_service, reading
from tests.benchmarks.serving_report import REACHED, Row
from tests.service.process import ServiceProcess, service_process

NAME = "hostile_load"
MOST_MB, MOST_AGE_MS, PAGES = 400, 60, 20
RATE_HZ, BODIES, IDLE = 90.0, 64, 2000
UNMEASURED = "not measured"
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
    piece = b"[],[" * (1 << 18)
    with httpx.Client(base_url=service.url(""), headers=service.bearer) as client:
        path = f"/v2/models/{deciding(client)[0]}/infer"

    def send(number: int) -> str:
        size = (31 << 20) if number % 2 else (6 << 20)
        lines = [f"Content-Length: {size}", *(["Inference-Header-Content-Length: 8"] if number % 2 else [])]
        with socket.create_connection(("127.0.0.1", service.port), 30) as link:
            try:
                link.sendall(head(service, path, *lines))
                for _ in range(size // len(piece)):
                    link.sendall(piece)
                return link.recv(4096).split(b" ")[1].decode()
            except (OSError, IndexError):
                return "closed"

    with most_mb(service) as most, ThreadPoolExecutor(BODIES) as senders:
        sent = [senders.submit(send, number) for number in range(BODIES)]
        greeted = greeted_s(service)
        answers = {one.result(60) for one in sent}
    return {"n": BODIES, "most_mb": round(most[0]), "greeted_s": round(greeted, 2), "answers": sorted(answers)}


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
    ages, load = [], {"pages": 0}
    with busy_service(models, RATE_HZ) as (service, _, link), contextlib.ExitStack() as stack:
        if flooded:
            with reading(link):  # what nobody reads while the crowd gathers would come late
                load = stack.enter_context(crowd(service, ["/v1/live"] * PAGES))
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            message = wire.parse_service(link.recv(20))
            if isinstance(message, wire.Watching):
                ages.append((time.monotonic_ns() - message.frame_captured_ns) / 1e6)
    p50, p99 = percentiles(ages, 50, 99)
    facts = {"p50_ms": round(p50, 1), "p99_ms": round(p99, 1), "most_ms": round(max(ages), 1), "n": len(ages)}
    return facts | load | {"judged_per_s": round(len(ages) / seconds, 1)}


def rows(facts: dict[str, Any]) -> list[Row]:
    """Measurements beside their targets; what was not measured says so."""
    made: list[Row] = []
    for name, what in (("ages alone", "alone"), ("ages flooded", f"{PAGES} pages and a flood of inference")):
        label = f"age of the newest judged frame, 2 x {RATE_HZ:.0f} fps, {what}: p50 / p99"
        if figures := facts.get(name):
            measured = f"{figures['p50_ms']:.0f} / {figures['p99_ms']:.0f} ms (n = {figures['n']:,})"
            reached, load = figures["p99_ms"] <= MOST_AGE_MS, figures["load"]
        made.append(Row(label, *((measured, f"p99 {MOST_AGE_MS} ms", reached, load) if figures else (UNMEASURED,))))
    for name, what in (("bodies", f"{BODIES} hostile bodies at once"), ("idle", f"{IDLE:,} idle connections")):
        label = f"{what}: memory; health checks and the robot's greeting, answered"
        if figures := facts.get(name):
            measured = f"{figures['most_mb']} MB; in {figures['greeted_s']:.1f} s"
            reached, load = figures["most_mb"] < MOST_MB, figures["load"]
        made.append(Row(label, *((measured, f"{MOST_MB} MB; yes", reached, load) if figures else (UNMEASURED,))))
    return made


def section(facts: dict[str, Any]) -> Table:
    """The table of a flood's cost."""
    columns = (("quantity", "quantity"), ("measured", "measured"), ("at most", "target"))
    return table(rows(facts), *columns, ("reached", lambda row: REACHED[row.reached]), ("load", "load", ".1f"))


def hostile_page(facts: dict[str, Any]) -> str:
    """docs/hostile_load.md."""
    missed = [row.quantity for row in rows(facts) if row.reached is False]
    flooded, measured = facts.get("ages flooded"), facts.get("machine")
    result = f"**Missed here:** {'; '.join(missed) or 'nothing'}." if measured else "**Not measured yet.**"
    where = f" on {measured['cpu']}, {measured['cores']} cores, with `{facts['models']}`" if measured else ""
    flood = (
        f"Each page got {flooded['page_messages_per_s']:.0f} messages a second or more, and"
        f" {flooded['inferences_per_s']:.0f} inferences a second were answered."
        if flooded
        else ""
    )
    return page(
        f"""
        # What a flood costs the robot

        {result}

        `make bench-hostile` measures this{where}. The load of a row is the average number of runnable processes after
        it, its own included.
        """,
        section(facts),
        f"""
        The service watches an attempt for slip, with two cameras at {RATE_HZ:.0f} fps. The age is that of the older
        finger's frame when the client is told that it was judged. {PAGES} pages look on from a process of their own,
        which also asks the networks that decide for inference, without a pause. {flood}

        The bodies are as large as they may be, and half of them are JSON that takes thirty times its size as Python
        objects. Health checks and a robot's greeting must be answered meanwhile, or the benchmark fails; so it does
        where a page or the flood dies, or gets nothing.
        """,
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", type=Path, default=Path("models/pressing"))
    parser.add_argument("--seconds", type=float, default=30.0, help="of each measurement of ages")
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder of the page and its data")
    options = parser.parse_args()
    parts: dict[str, Callable[[], dict[str, Any]]] = {
        "ages alone": lambda: ages_ms(options.models, options.seconds, flooded=False),
        "ages flooded": lambda: ages_ms(options.models, options.seconds, flooded=True),
    }
    facts: dict[str, Any] = {"machine": machine(), "models": str(options.models)}
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
    publish(options.out, NAME, hostile_page(facts), facts)
    print(section(facts).text())
    return 0 if all(row.reached for row in rows(facts)) else 1


if __name__ == "__main__":
    sys.exit(main())
