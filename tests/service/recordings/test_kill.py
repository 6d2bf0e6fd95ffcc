"""A real service process, killed by a real SIGKILL in the middle of an insertion."""

import json
import time
from pathlib import Path

import httpx
import pytest

from service import __main__ as entry
from service.contract import wire
from service.recordings.reader import Recording
from tests.service import drawn
from tests.service.client import Driver
from tests.service.mjpeg import FakeFinger
from tests.service.process import service_process


@pytest.mark.slow
def test_a_killed_service_has_kept_the_insertion_and_makes_it_whole_at_the_next_start(
    tmp_path: Path, models_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fingers = FakeFinger("left"), FakeFinger("right")
    calibration, recordings = tmp_path / "calibration.toml", tmp_path / "recordings"
    drawn.calibration().save(calibration)
    options = ["--camera-left", fingers[0].url, "--camera-right", fingers[1].url, "--calibration", str(calibration)]
    options += ["--max-frame-age-ms", "20000", "--reference-timeout-s", "30"]  # the machine may be busy
    options += ["--frames-timeout-s", "30", "--decision-timeout-s", "60", "--client-timeout-s", "60"]

    class Cell:
        def __init__(self, running):
            self.url, self.bearer, self.fingers = running.url, running.bearer, fingers

        def probe(self) -> None:
            for finger in fingers:
                finger.probe(time.monotonic())

    with service_process(models_folder, recordings, *options) as service:
        driver = Driver(Cell(service), "killed")
        driver.until("hello")
        decided = driver.attempt(1)
        driver.rest()
        driver.send(wire.Arm(insertion_id="killed", attempt=2, gap_width_mm=56.0, expected_depth_mm=25.0))
        driver.until("armed")
        time.sleep(3.0)
        killed_ns = time.time_ns()
        service.kill()
    (part,) = recordings.glob("*_killed/insertion.mcap.part")
    with service_process(models_folder, recordings, *options) as service:
        (entry_,) = httpx.get(service.url("/v1/recordings")).json()["recordings"]
        assert (entry_["insertion_id"], entry_["outcome"], entry_["attempts"]) == ("killed", "interrupted", 2)
    whole = part.with_name("insertion.mcap")
    assert not part.exists()
    recording = Recording(whole)
    assert recording.complete
    for finger in ("left", "right"):
        stamps = [e.log_ns for e in recording.of(f"/{finger}/image")]
        assert killed_ns - max(stamps) < 1.0e9
    messages = [e.json()["message"] for e in recording.of("/messages")]
    (correction,) = [m for m in messages if m["type"] == "correction"]
    assert wire.parse_service(json.dumps(correction)) == decided
    assert entry.main(["replay", str(whole), "--models", str(models_folder)]) == 0
    assert "all the same bit for bit" in capsys.readouterr().out
    for finger in fingers:
        finger.close()
