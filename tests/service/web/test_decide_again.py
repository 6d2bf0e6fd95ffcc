"""Deciding a recorded insertion again, from the page or the API: with which networks, and how large a one."""

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import httpx
import pytest

from service.recordings.need import needed
from service.recordings.reader import Recording
from tests.service import tiny_models
from tests.service.client import greeted
from tests.service.conftest import LiveService, live_service
from tests.service.versions.test_live import ask, insert
from tests.waiting import wait_for


def decided_again(live: LiveService, path: Path) -> httpx.Response:
    return httpx.post(live.url(f"/v1/recordings/{path.parent.name}/decide"), timeout=120)


def test_the_version_that_decided_an_insertion_decides_it_again(tmp_path: Path) -> None:
    with live_service(tmp_path, tiny_models.write_models(tmp_path / "models")) as live:
        shadow = tiny_models.write_models(tmp_path / "shadow", git_commit="1" * 40)
        _, released = insert(live, "released")
        assert ask(live, "POST", "/shadow", folder=str(shadow)).is_success
        assert ask(live, "POST", "/promote").is_success
        _, promoted = insert(live, "promoted")
        for path in (promoted, released):
            again = decided_again(live, path).json()
            assert again["same"] is True, again


def test_a_recording_that_is_too_large_is_refused(live: LiveService, monkeypatch: pytest.MonkeyPatch) -> None:
    first = Path(greeted(live, "first").after(1).gives_up("afresh", "turned_in_hand").recording)
    again = greeted(live, "second", continues="first")
    assert again.insert(1).outcome == "inserted"
    again.close()
    (second,) = live.recordings.glob("*_second/insertion.mcap")
    messages_n = sum(len(entry.data) for path in (first, second) for entry in Recording(path).entries)
    bytes_n = needed(second).bytes_n
    assert messages_n < bytes_n < 1.5 * messages_n, "those of the insertion before are read, too"
    monkeypatch.setattr("service.web.routes.playback.MOST_AGAIN_BYTES", bytes_n - 1)
    refused = decided_again(live, second)
    assert refused.status_code == 422
    assert "on another one" in refused.json()["error"]
    monkeypatch.undo()
    assert decided_again(live, second).json()["same"] is True


def test_an_insertion_that_begins_ends_what_is_being_decided_again(
    live: LiveService, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    _, path = insert(live, "earlier")
    slow = tmp_path / "slow"
    slow.write_text(f"#!/bin/sh\necho $$ > {tmp_path / 'number'}\nexec sleep 60\n")
    slow.chmod(0o755)
    monkeypatch.setattr("service.web.routes.playback.sys", SimpleNamespace(executable=str(slow)))
    with ThreadPoolExecutor(1) as beside:
        answer = beside.submit(decided_again, live, path)
        number = wait_for(lambda: (tmp_path / "number").is_file() and (tmp_path / "number").read_text().strip())
        wait_for(lambda: os.getpriority(os.PRIO_PROCESS, int(number)) > os.getpriority(os.PRIO_PROCESS, 0))
        driver = greeted(live, "next")
        refused = answer.result(30)
    driver.gives_up()
    assert refused.status_code == 409
    assert refused.json()["error"] == "busy: an insertion has begun"
    command = Path(f"/proc/{number}/cmdline")
    wait_for(lambda: not command.exists() or not command.read_text())
