"""Those who look back at recordings leave the processor to an insertion that is under way, and so do slow disks."""

import asyncio
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import httpx
import pytest

from service.recordings.writer import Recorder
from service.session.station import Station
from service.web.page.status import SILENT_REMEDY, STANDSTILL, Status
from service.web.reading import Reading
from tests.service.client import Driver
from tests.service.conftest import LiveService
from tests.waiting import wait_for

READ_S = 0.02


async def test_recordings_are_read_one_at_a_time_and_seldom_during_an_insertion() -> None:
    spans: list[tuple[float, float]] = []

    def read(number: int) -> int:
        began_s, spent_s = time.monotonic(), time.thread_time()
        while time.thread_time() - spent_s < READ_S:
            pass
        spans.append((began_s, time.monotonic()))
        return number

    station: Any = SimpleNamespace(active=object())
    reading, began_s = Reading(station), time.monotonic()
    assert await asyncio.gather(*(reading(read, number) for number in range(5))) == [0, 1, 2, 3, 4]
    took_s = time.monotonic() - began_s
    assert all(ended_s <= next_s for (_, ended_s), (next_s, _) in pairwise(spans))
    assert len(spans) * READ_S <= 0.25 * took_s


async def test_a_read_that_waits_for_its_disk_keeps_nobody_waiting_for_longer() -> None:
    """It leaves the interpreter to the fingers, so that there is nothing to make up for."""
    answers = threading.Event()
    station: Any = SimpleNamespace(active=object())
    reading = Reading(station)
    slow = asyncio.create_task(reading(answers.wait, 60))
    began_s = time.monotonic()
    asyncio.get_running_loop().call_later(0.5, answers.set)
    assert await slow
    assert time.monotonic() - began_s < 1.5


def test_recordings_are_listed_after_the_one_that_is_being_read(
    live: LiveService, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, answers = threading.Event(), threading.Event()

    def curves(*_: object) -> dict[str, Any]:
        asked.set()
        answers.wait(60)
        return {}

    monkeypatch.setattr("service.web.routes.playback.recording_file", lambda *_: None)
    monkeypatch.setattr("service.web.routes.playback.timeline", curves)
    with ThreadPoolExecutor() as those:
        played = those.submit(httpx.get, live.url("/v1/recordings/one/timeline"), timeout=90)
        try:
            assert asked.wait(30)
            with pytest.raises(httpx.ReadTimeout):
                httpx.get(live.url("/v1/recordings"), timeout=1.0)
        finally:
            answers.set()
        assert played.result().status_code == httpx.get(live.url("/v1/recordings"), timeout=30).status_code == 200


async def test_a_recording_that_cannot_be_read_is_refused_as_ever() -> None:
    def broken() -> None:
        raise ValueError("no recording")

    station: Any = SimpleNamespace(active=object())
    with pytest.raises(ValueError, match="no recording"):
        await Reading(station)(broken)


def test_a_disk_that_does_not_answer_keeps_nobody_waiting(live: LiveService, monkeypatch: pytest.MonkeyPatch) -> None:
    """Prometheus and a healthcheck ask every few seconds, for as long as it hangs; messages go the same way."""
    answers = threading.Event()
    for limit in ("ANSWER_S", "SILENT_S"):
        monkeypatch.setattr(f"service.web.page.disk.{limit}", 0.1)
    monkeypatch.setattr("service.session.manager.problem_of", lambda _: "" if answers.wait(60) else "late")
    try:
        problem = wait_for(lambda: (ready := httpx.get(live.url("/readyz"), timeout=30)).status_code == 503 and ready)
        assert "has not answered" in problem.json()["recording"]
        wait_for(lambda: "tactile_recording_ok 0.0" in live.metrics())
        assert httpx.get(live.url("/healthz"), timeout=30).status_code == 200
    finally:
        answers.set()
    wait_for(lambda: httpx.get(live.url("/readyz"), timeout=30).status_code == 200)
    wait_for(lambda: "tactile_recording_ok 1.0" in live.metrics())


def test_a_disk_that_does_not_answer_keeps_no_page_from_the_state(
    live: LiveService, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its pictures would go on, above the sentence of before: that the arm holds would be shown to nobody."""
    shown, answers = Status(live.station), threading.Event()
    for limit in ("ANSWER_S", "SILENT_S"):
        monkeypatch.setattr(f"service.web.page.disk.{limit}", 0.1)
    monkeypatch.setattr("service.session.manager.problem_of", lambda _: "" if answers.wait(60) else "late")
    with ThreadPoolExecutor() as those:
        try:
            state = those.submit(shown.snapshot).result(20)
            assert state["headline"]["words"] == "Ready for the next object"
            (alarm,) = wait_for(lambda: shown.snapshot()["alarms"])
            assert "has not answered" in alarm["detail"]
            assert alarm["remedy"] == SILENT_REMEDY, "no room that is made there would help"
        finally:
            answers.set()
    wait_for(lambda: not shown.snapshot()["health"]["recording"])


def test_a_recording_that_its_disk_does_not_open_is_no_readiness_and_the_page_says_so(
    live: LiveService, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its thread answers no client meanwhile, and no other count moves: the cell would stand, and nobody be told."""
    answers, shown = threading.Event(), Status(live.station)
    for limit in ("web.page.disk.ANSWER_S", "web.page.disk.SILENT_S", "session.station.STANDSTILL_S"):
        monkeypatch.setattr(f"service.{limit}", 0.5)
    monkeypatch.setattr("service.session.manager.Recorder", lambda *given: answers.wait(60) and Recorder(*given))
    monkeypatch.setattr("service.session.manager.problem_of", lambda _: "" if answers.wait(60) else "late")
    live.station.manager._unrecorded = "frames were left out: the disk is too slow"  # of the last insertion
    driver = Driver(live, "waits")
    try:
        ready = wait_for(lambda: (asked := httpx.get(live.url("/readyz"), timeout=30)).status_code == 503 and asked)
        wait_for(lambda: live.station.standstill)
        assert httpx.get(live.url("/readyz"), timeout=30).json()["perception"].startswith("no frame is judged")
        assert set(ready.json()["cameras"].values()) == {"live"}
        assert "tactile_ready 0.0" in live.metrics()
        wait_for(lambda: shown.snapshot()["headline"]["detail"].startswith(f"{SILENT_REMEDY}\nno frame is judged"))
        headline = shown.snapshot()["headline"]
        assert (headline["level"], headline["words"]) == ("warning", STANDSTILL)
    finally:
        answers.set()
    driver.until("hello")
    wait_for(lambda: shown.snapshot()["running"])
    with monkeypatch.context() as again:
        again.setattr(Station, "standstill", "no frame is judged")
        headline = shown.snapshot()["headline"]
        assert headline == {"level": "warning", "words": "The robot is connected", "detail": STANDSTILL}
    driver.gives_up()
    wait_for(lambda: httpx.get(live.url("/readyz"), timeout=30).json()["perception"] == "ok")
    assert "tactile_ready 1.0" in live.metrics()
