"""The cost of those who look on: each picture is drawn once for all of them, and twenty pages take little time."""

import asyncio
import contextlib
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from websockets.sync.client import connect

from service.cameras.capture import CameraFrame
from service.contract import FINGERS, TactileFrame
from service.web.page import broadcast
from service.web.routes import cameras
from tests.benchmarks.load import busy_service, reading
from tests.service.process import ServiceProcess
from tests.waiting import until

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


def frames(seq: int) -> dict[str, CameraFrame]:
    """Of cameras that send pixels, not JPEGs."""
    pixels = np.full((8, 8, 3), seq, np.uint8)
    return {finger: CameraFrame(TactileFrame(finger, seq, seq, pixels), None) for finger in FINGERS}


@pytest.mark.parametrize(("form", "encoder"), [("jpeg", "encode_jpeg"), ("raw", "encode_frame")])
async def test_a_frame_is_encoded_once_for_all_viewers(
    form: cameras.Form, encoder: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    encoded, made = cameras.Encoded(), Mock(side_effect=[b"first", b"second"])
    monkeypatch.setattr(cameras, encoder, made)
    for seq, expected in ((1, b"first"), (2, b"second")):
        assert set(await asyncio.gather(*(encoded.of(frames(seq)["left"], form) for _ in range(5)))) == {expected}
    assert made.call_count == 2


async def test_a_picture_is_drawn_once_for_all_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(broadcast, "PERIOD_S", 0.01)
    drawn = Mock(side_effect=lambda frame, *_: f"{frame.frame.finger} {frame.frame.seq}")
    monkeypatch.setattr(broadcast, "_drawn", drawn)
    hub = SimpleNamespace(frames=frames(1), observations={})
    station: Any = SimpleNamespace(manager=SimpleNamespace(calibration=None), hub=hub, active=None)
    status: Any = SimpleNamespace(changes_n=0, snapshot=dict)
    with contextlib.ExitStack() as stack:
        shown = broadcast.Broadcast(station, status)
        looking = [stack.enter_context(shown.page()) for _ in range(3)]
        for seq in (1, 2):
            hub.frames = frames(seq)
            expected = {finger: f"{finger} {seq}" for finger in FINGERS}
            await until(lambda expected=expected: all(expected.items() <= page.newest.items() for page in looking))
            await asyncio.sleep(0.1)  # and not again while no new one comes
    assert drawn.call_count == 2 * len(FINGERS)
