"""A service that is stopped in mid-insertion: nothing that it has seen is lost, and nobody takes its folder before."""

import threading
import time
from pathlib import Path
from typing import Any

from service.contract import wire
from service.recordings.listing import list_recordings
from service.session.station import Station, open_station
from service.settings import Settings

SLOW_S = 1.0  # the disk


def begun(folder: Path, models: Path) -> Station:
    settings = Settings(
        models=models, camera_left="push:", camera_right="push:", recordings=folder / "r", state=folder / "s"
    )
    station = open_station(settings)
    station.start()
    heard = threading.Event()
    station.connect(wire.ClientHello(insertion_id="cut", client="test"), lambda _: heard.set())
    assert heard.wait(20)
    return station


def test_a_service_that_stops_waits_until_the_insertion_under_way_is_kept(tmp_path: Path, models_folder: Path) -> None:
    station = begun(tmp_path, models_folder)
    kept: list[tuple[str, bool]] = []

    def look(kind: str, content: Any) -> None:
        if kind == "recorded":
            kept.append((content.cause, station.owned is not None and not station.owned.closed))

    station.hub.subscribe(look)
    insertion = station.active
    assert insertion
    assert insertion.recorder
    insertion.recorder.work_out("/beside", lambda: time.sleep(SLOW_S) or {}, time.monotonic_ns())
    station.stop()
    assert kept == [("service", True)], "while the folder is still this service's own"
    listed, problems = list_recordings(station.settings.recordings)
    assert ([one["insertion_id"] for one in listed], problems) == (["cut"], [])
    assert Path(str(insertion.session.recording)).is_file()
    assert station.manager.closing
    assert not station.manager.closing.daemon, "an end of the process would cut it off"
