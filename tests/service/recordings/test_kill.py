"""A real service process, killed by a real SIGKILL in the middle of an insertion."""

import json
import time
from pathlib import Path

import httpx
import pytest

from service import __main__ as entry
from service.contract import FINGERS, wire
from service.recordings.reader import Recording
from tests.service.apart import apart
from tests.service.client import greeted
from tests.service.recordings.test_episode import tell


@pytest.mark.slow
def test_a_killed_service_has_kept_the_insertion_and_makes_it_whole_at_the_next_start(
    tmp_path: Path, models_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with apart(tmp_path, models_folder) as live:
        driver = greeted(live, "killed", purpose="probe")
        decided = driver.attempt(1)
        driver.arms(2)
        told_ns = tell(driver, seconds=3.0)
        killed_ns = time.time_ns()
        live.service.kill()
    (part,) = tmp_path.glob("recordings/*_killed/insertion.mcap.part")
    with apart(tmp_path, models_folder) as live:
        (row,) = httpx.get(live.url("/v1/recordings")).json()["recordings"]
        assert (row["insertion_id"], row["outcome"], row["cause"]) == ("killed", "interrupted", "service")
        assert (row["object"], row["attempts"]) == ("box", 2)
    whole = part.with_name("insertion.mcap")
    assert not part.exists()
    recording = Recording(whole)
    assert recording.complete
    for finger in FINGERS:
        stamps = [e.log_ns for e in recording.of(f"/{finger}/image")]
        assert killed_ns - max(stamps) < 1.0e9
    newest_ns = max(e.log_ns for e in recording.of("/robot")) - recording.offset_ns
    assert told_ns[-1] - newest_ns < 0.5e9, "all but half a second of the robot"
    messages = [e.json()["message"] for e in recording.of("/messages")]
    (correction,) = [m for m in messages if m["type"] == "correction"]
    assert wire.parse_service(json.dumps(correction)) == decided
    assert entry.main(["replay", str(whole), "--models", str(models_folder)]) == 0
    assert "all the same bit for bit" in capsys.readouterr().out
