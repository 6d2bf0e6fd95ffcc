"""The cost of twenty pages while an attempt is watched: processor time with and without them, in turns."""

import contextlib
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from websockets.sync.client import connect

from tests.benchmarks.load import busy_service, reading
from tests.service.process import ServiceProcess

PAGES_N, MOST_CORES, TURN_S = 20, 0.2, 8.0


def cores(service: ServiceProcess) -> float:
    began_s, used_s = time.monotonic(), service.cpu_s()
    time.sleep(TURN_S)
    return (service.cpu_s() - used_s) / (time.monotonic() - began_s)


@contextlib.contextmanager
def pages(service: ServiceProcess, heard: list[int]) -> Iterator[None]:
    stop = threading.Event()

    def look() -> None:
        with connect(service.url("/v1/live", "ws")) as link:
            while not stop.is_set():
                with contextlib.suppress(TimeoutError):
                    heard.append(len(link.recv(1.0)))

    threads = [threading.Thread(target=look) for _ in range(PAGES_N)]
    for thread in threads:
        thread.start()
    try:
        time.sleep(2.0)
        yield
    finally:
        stop.set()
        for thread in threads:
            thread.join()


@pytest.mark.slow
def test_twenty_pages_cost_less_than_a_fifth_of_a_core(models_folder: Path) -> None:
    with busy_service(models_folder, 30.0) as (service, _, link), reading(link):
        differences = []
        for _ in range(2):
            alone, heard = cores(service), []
            with pages(service, heard):
                together = cores(service)
            differences.append(together - alone)
            rate_hz = len(heard) / PAGES_N / (TURN_S + 2.0)
            print(f"{alone:.3f} cores alone, {together:.3f} with {PAGES_N} pages of {rate_hz:.0f} messages a second")
            assert rate_hz > 5.0, "the pages saw what happened"
    assert sum(differences) / len(differences) <= MOST_CORES
