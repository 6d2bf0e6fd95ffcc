"""Thousands of recordings are listed beside the event loop, which passes the robot's messages on."""

import json
import os
from pathlib import Path

import httpx
import pytest

from service.recordings.listing import list_recordings
from service.recordings.writer import Recorder
from service.web.routes.recordings import Recordings
from tests.service.process import ServiceProcess, service_process

MANY = 4000
DECIDED = {"correction": [1.0, 2.0], "interval_x_mm": [-3.0, 1.0], "interval_theta_deg": [-3.0, 1.0]}


def keep_many(root: Path) -> None:
    decisions = [DECIDED | {"attempt": number, "reach_pitch": float("nan")} for number in (1, 2, 3)]
    for number in range(MANY):
        folder = root / f"202601{1 + number // 3600:02d}T00{number // 60 % 60:02d}{number % 60:02d}_box-{number}"
        folder.mkdir(parents=True)
        facts = {"insertion_id": f"box-{number}", "outcome": "inserted", "attempts": 4, "decisions": decisions}
        (folder / "summary.json").write_text(json.dumps(facts))


def test_a_recording_is_listed_once_its_file_can_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A slow disk takes its time between the summary and the file's own name; who found it listed got a 404."""
    meanwhile = []
    monkeypatch.setattr("service.recordings.writer.put_on_disk", lambda _: meanwhile.append(list_recordings(tmp_path)))
    path = Recorder(tmp_path, "one", {}).close({"outcome": "inserted", "attempts": 1})
    assert meanwhile == [([], [])]
    listed, problems = list_recordings(tmp_path)
    assert ([one["name"] for one in listed], problems) == ([path.parent.name], [])
    assert path.is_file()


def loop_s(service: ServiceProcess) -> float:
    """Processor time of the event loop: it runs in the first thread."""
    pid = service.process.pid
    fields = Path(f"/proc/{pid}/task/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def test_the_event_loop_has_next_to_no_part_in_listing_many_recordings(tmp_path: Path, models_folder: Path) -> None:
    keep_many(tmp_path / "r")
    cameras = ["--camera-left", "push:", "--camera-right", "push:", "--camera-wait-s", "0"]
    with service_process(models_folder, tmp_path / "r", *cameras) as service:
        for _ in range(2):  # the first answer of a process has more to do
            before = loop_s(service), service.cpu_s()
            answer = httpx.get(service.url("/v1/recordings"), timeout=60)
            spent_s, all_s = loop_s(service) - before[0], service.cpu_s() - before[1]
    listed = Recordings.model_validate_json(answer.content)
    assert ([one.name for one in listed.recordings][:: MANY - 1], listed.problems) == (
        ["20260102T000639_box-3999", "20260101T000000_box-0"],
        [],
    )
    assert listed.recordings[0].decisions[0].reach_pitch is None, "JSON has no NaN"
    assert spent_s < 0.25 * all_s, (spent_s, all_s)
