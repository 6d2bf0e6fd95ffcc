"""Alarms: however many come while nobody looks, a person reaches and acknowledges each of them."""

import asyncio
import json
import os
import shutil
import threading
from pathlib import Path

import httpx
import pytest

from service.contract import FINGERS, wire
from service.observability.charts import Charts
from service.session.station import open_station
from service.settings import Settings
from service.web.metrics import Metrics
from service.web.page.alarms import EARLIER, KEPT_N, Alarms
from service.web.page.status import SHOWN_ALARMS_N, Status
from tests.service.client import greeted
from tests.service.conftest import LiveService, live_service
from tests.service.web.test_status import status, until
from tests.waiting import wait_for


def lose_a_part(live: LiveService, name: str) -> None:
    driver = greeted(live, name)
    driver.gives_up("part_lost", "gripper: part_lost")


def test_more_failures_than_the_page_lists_are_all_acknowledged_one_after_the_other(live: LiveService) -> None:
    lost_n = SHOWN_ALARMS_N + 2
    for number in range(lost_n):
        lose_a_part(live, f"lost-{number}")
    shown = until(live, lambda shown: shown["open_alarms_n"] == lost_n)
    assert [alarm["acknowledged_s"] for alarm in shown["alarms"]] == [None] * lost_n
    assert Status(live.station).snapshot()["open_alarms_n"] == lost_n, "a restart forgets none"
    while shown["headline"]["level"] == "stop":
        first = next(alarm for alarm in shown["alarms"] if alarm["acknowledged_s"] is None)
        httpx.post(live.url(f"/v1/alarms/{first['number']}/acknowledge")).raise_for_status()
        shown = status(live)
    assert shown["open_alarms_n"] == 0
    assert len(shown["alarms"]) == SHOWN_ALARMS_N


def test_a_client_whose_link_is_lost_in_mid_attempt_drives_no_more_and_the_page_says_so(live: LiveService) -> None:
    lost = greeted(live, "cut")
    lost.arms(1)
    lost.send(wire.Descending(insertion_id="cut", attempt=1))
    shown = until(live, lambda shown: "lowering" in shown["headline"]["words"])
    assert (shown["headline"]["level"], shown["health"]["driver"]) == ("busy", "cut")
    lost.close()
    shown = until(live, lambda shown: shown["health"]["driver"] is None)
    assert shown["headline"]["words"] == "Attempt 1 of 15: lowering the object into the gap"
    assert shown["headline"]["level"] == "warning"
    assert shown["headline"]["detail"] == "No connection to the robot client"
    again = greeted(live, "cut")
    shown = until(live, lambda shown: shown["health"]["driver"] == "cut")
    assert (shown["headline"]["level"], shown["headline"]["detail"]) == ("busy", "")
    again.gives_up()


def test_the_oldest_of_too_many_unacknowledged_alarms_become_one_that_counts_them(tmp_path: Path) -> None:
    alarms = Alarms(tmp_path / "alarms.json")
    alarms.sound("camera left", "warning", "Left camera lost")
    for number in range(KEPT_N + 5):
        alarms.sound(f"insertion {number}", "stop", "Holding: all attempts used")
    earlier = Alarms(tmp_path / "alarms.json").open[-1]
    assert (len(alarms.open), earlier.key, earlier.level, earlier.times_n) == (KEPT_N, EARLIER, "stop", 7)
    assert alarms.acknowledge(earlier.number)
    alarms.sound("insertion next", "stop", "Holding: all attempts used")
    assert [alarm.key for alarm in alarms.open][::49] == ["insertion next", "insertion 6"], "only the acknowledged goes"


def test_a_camera_that_is_lost_while_the_service_starts_has_an_alarm_with_the_reason_and_counts(
    tmp_path: Path, models_folder: Path
) -> None:
    """As after a power cut: nobody followed the events yet, and a camera that stays lost makes no other."""
    nobody = {f"camera_{finger}": f"http://127.0.0.1:9/{finger}" for finger in FINGERS}
    station = open_station(
        Settings(models=models_folder, recordings=tmp_path / "recordings", state=tmp_path / "state", **nobody)
    )
    station.start()
    try:
        wait_for(lambda: all(camera.state == "lost" for camera in station.cameras.values()))
        page, metrics = Status(station), Metrics(station)
        alarms = page.snapshot()["alarms"]
        counted = asyncio.run(metrics.exposition())[0].decode()
    finally:
        station.stop()
    assert {alarm["title"] for alarm in alarms} == {"Left camera lost", "Right camera lost"}
    assert all("refused" in alarm["detail"] for alarm in alarms)
    for finger in FINGERS:
        assert f'tactile_camera_faults_total{{code="camera_lost",finger="{finger}"}} 1.0' in counted


def test_insertions_that_are_not_recorded_raise_an_alarm_each_time_that_begins_and_only_then(
    tmp_path: Path, models_folder: Path
) -> None:
    with live_service(tmp_path, models_folder) as live:
        for _ in range(2):  # again, after the first was acknowledged and was over
            live.recordings.mkdir(exist_ok=True)
            assert status(live)["open_alarms_n"] == 0
            shutil.rmtree(live.recordings)
            assert [acknowledged(live), status(live)["open_alarms_n"]] == ["recording", 0]
        live.station.hub.publish("error", "another alarm")
        assert [acknowledged(live), status(live)["open_alarms_n"]] == ["service", 0]


def test_an_insertion_that_was_not_recorded_while_nobody_looked_is_one_alarm_in_plain_words(
    tmp_path: Path, models_folder: Path
) -> None:
    with live_service(tmp_path, models_folder) as live:
        driver = greeted(live, "unseen")
        with Path("/dev/full").open("wb") as full:
            os.dup2(full.fileno(), live.station.active.recorder._stream.fileno())
        assert driver.insert(1).outcome == "inserted"
        driver.close()
        until(live, lambda _: live.station.manager.unrecorded_n == 1)
        (alarm,) = status(live)["alarms"]
        assert (alarm["key"], alarm["times_n"]) == ("recording", 1)
        assert alarm["detail"].endswith("insertion.mcap: No space left on device")
        assert "Make room on that disk" in alarm["remedy"]


def test_a_recording_without_an_end_blames_the_full_disk_as_well_as_the_service(
    tmp_path: Path, models_folder: Path
) -> None:
    folder = tmp_path / "recordings" / "20260101T000000000000_full"
    folder.mkdir(parents=True)
    ended = {"insertion_id": "full", "outcome": "interrupted", "cause": "service", "attempts": 1}
    (folder / "summary.json").write_text(json.dumps(ended))
    with live_service(tmp_path, models_folder) as live:
        (alarm,) = status(live)["alarms"]
        assert (alarm["key"], alarm["level"]) == ("insertion full", "stop")
        assert alarm["detail"] == "The service ended during it, or the disk was full."


def test_an_alarm_waits_for_no_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    answers, waited = threading.Event(), []
    monkeypatch.setattr("service.web.page.alarms.write_durably", lambda *_: waited.append(answers.wait(10)))
    Alarms(tmp_path / "alarms.json").sound("service", "warning", "Fault of the service")
    assert waited == []
    answers.set()


@pytest.mark.parametrize("kept", ["alarms.json", "charts.json"])
def test_what_outlives_a_restart_is_on_the_disk_before_it_takes_its_forerunners_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kept: str
) -> None:
    """Else a power cut soon after leaves an empty file, and with it no alarm of before either."""
    on_disk: dict[int, int] = {}
    monkeypatch.setattr(os, "fsync", lambda number: on_disk.update({os.fstat(number).st_ino: os.fstat(number).st_size}))
    if kept == "charts.json":
        Charts(tmp_path / kept).keep()
    else:
        Alarms(tmp_path / kept).sound("service", "warning", "Fault of the service")
        assert len(Alarms(tmp_path / kept).all) == 1, "read behind what is being written"
    file, folder = (tmp_path / kept).stat(), tmp_path.stat()
    assert on_disk == {file.st_ino: file.st_size, folder.st_ino: folder.st_size}


def test_a_disk_is_not_asked_while_events_wait_for_the_answer(
    live: LiveService, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown, locked = Status(live.station), []
    live.station.hub.publish("unrecorded", "the disk is full")
    monkeypatch.setattr("service.session.manager.problem_of", lambda _: locked.append(shown._lock.locked()) or "")
    assert shown.snapshot()["alarms"][0]["key"] == "recording"
    assert locked == [False]


def test_a_kept_alarm_of_a_camera_that_is_not_there_is_shown_as_past(live: LiveService) -> None:
    shown = Status(live.station)
    shown._alarms.sound("camera upper", "stop", "of an earlier version")
    (alarm,) = (one for one in shown.snapshot()["alarms"] if one["key"] == "camera upper")
    assert not alarm["active"]


def acknowledged(live: LiveService) -> str:
    """Acknowledge the only open alarm; its key."""
    (alarm,) = (one for one in status(live)["alarms"] if not one["acknowledged_s"])
    httpx.post(live.url(f"/v1/alarms/{alarm['number']}/acknowledge")).raise_for_status()
    return alarm["key"]
