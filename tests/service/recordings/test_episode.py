"""One file tells the whole episode: what was to be done, what the robot did, what was said and judged, how it ended."""

import json
import time
from pathlib import Path
from unittest.mock import Mock

import httpx

from service.contract import FINGERS, wire
from service.recordings.reader import Recording
from service.recordings.writer import IMAGE, Recorder
from service.session.insertion import Insertion
from tests.service.client import Driver, greeted
from tests.service.conftest import LiveService

POSE = wire.ToolPose(x_mm=8.0, y_mm=0.0, z_mm=35.0, yaw_deg=6.0)
AHEAD_NS = 7_000_000_000_000  # the client's clock, on another machine


def tell(driver: Driver, *, seconds: float = 0.0, left_out_n: int = 0) -> list[int]:
    """The task, and a robot's samples from now on; returns their stamps on this machine's clock."""
    named = driver.id
    driver.send(wire.Episode(insertion_id=named, object="box", start=POSE, approach=POSE, versions={"client": "0.1.0"}))
    stamps, until = [], time.monotonic() + seconds
    while not stamps or time.monotonic() < until:
        now_ns = time.monotonic_ns()
        samples = [
            wire.RobotSample(at_ns=now_ns + AHEAD_NS - k, phase="descending", attempt=1, measured=POSE, depth_mm=1.5)
            for k in (20_000_000, 0)
        ]
        driver.send(
            wire.Telemetry(insertion_id=named, sent_ns=now_ns + AHEAD_NS, samples=tuple(samples), left_out_n=left_out_n)
        )
        stamps += [now_ns - 20_000_000, now_ns]
        time.sleep(0.04)
    return stamps


def episode(live: LiveService, name: str, cause: wire.Cause | None = None, **fields: object) -> tuple[Path, list[int]]:
    """A recorded insertion: made, or given up for a cause."""
    driver = greeted(live, name)
    stamps = tell(driver, **fields)
    driver.attempt(1)
    if cause is None:
        finished = driver.insert(2)
    else:
        driver.send(wire.Abort(insertion_id=name, cause=cause, reason="test"))
        finished = driver.until("finished")
    driver.close()
    return Path(finished.recording), stamps


def test_the_file_holds_task_robot_and_end(live: LiveService) -> None:
    path, stamps = episode(live, "whole-episode", seconds=0.5, left_out_n=1)
    recording = Recording(path)
    summary = json.loads((path.parent / "summary.json").read_text())
    expected = {"outcome": "inserted", "cause": None, "attempts": 2, "object": "box", "start": POSE.model_dump()}
    assert {key: summary[key] for key in expected} == expected
    assert summary["versions"] == {"client": "0.1.0"}
    assert summary["robot_samples_lost_n"] == len(stamps) // 2
    assert (recording.outcome["outcome"], recording.outcome["object"]) == ("inserted", "box")
    assert json.loads(recording.outcome["start"]) == POSE.model_dump()
    versions = json.loads(recording.metadata["versions"])
    assert versions["protocol"] == str(wire.PROTOCOL)
    assert set(versions) >= {"service", "numpy", "onnxruntime", "opencv"}
    robot = recording.of("/robot")
    assert [wire.RobotSample.model_validate_json(entry.data).depth_mm for entry in robot] == [1.5] * len(stamps)
    late_ms = [(e.log_ns - recording.offset_ns - ns) / 1e6 for e, ns in zip(robot, stamps, strict=True)]
    assert -1.0 < min(late_ms) <= max(late_ms) < 500.0  # the other machine's clock is mapped; this one may be busy
    kinds = [e.json()["message"]["type"] for e in recording.of("/messages")]
    assert kinds.count("episode") == kinds.count("finished") == 1
    assert "telemetry" not in kinds
    markers_n = {finger: len(recording.of(f"/{finger}/markers")) for finger in FINGERS}
    assert min(markers_n.values()) >= 8


def test_a_clients_clock_that_falls_as_far_as_it_can_ends_no_recording(tmp_path: Path) -> None:
    """A time below 0 left a broken record in its chunk, and nothing more could be written."""
    recorder = Recorder(tmp_path, "clock", {})
    insertion = Insertion(Mock(attempt=None), recorder, None, Mock())
    for sent_ns in ((1 << 62) - 1, 0):
        sample = wire.RobotSample(at_ns=sent_ns, phase="descending", attempt=1)
        insertion.message(wire.Telemetry(insertion_id="clock", sent_ns=sent_ns, samples=(sample,)))
        insertion._settle()
    recorder.message("service", {"type": "finished"}, 0)
    recording = Recording(recorder.close({"outcome": "failed", "attempts": 1}))
    assert (recording.complete, recorder.problem) == (True, "")
    assert [entry.topic for entry in recording.entries] == ["/robot", "/robot", "/messages"]


def test_a_camera_that_sends_jpeg_is_never_recorded_as_pixels(live: LiveService) -> None:
    """A pair's other half, too, is the frame that its camera sent."""
    for number in range(2):
        path, _ = episode(live, f"jpegs-{number}", "operator")
        recording = Recording(path)
        for finger in FINGERS:
            assert recording.of(f"/{finger}/{IMAGE[next(k for k in IMAGE if 'Raw' in k.DESCRIPTOR.name)]}") == []
            assert recording.of(f"/{finger}/image")


def given_up(live: LiveService, name: str, cause: wire.Cause) -> Path:
    """The recording of an insertion that ends before its first attempt."""
    driver = greeted(live, name)
    finished = driver.gives_up(cause, "test")
    return Path(finished.recording)


def counted(live: LiveService) -> dict[tuple[str, str], float]:
    name, values = "tactile_insertions_total{", {}
    for line in live.metrics().splitlines():
        if not line.startswith(name):
            continue
        labels, value = line.removeprefix(name).split("} ")
        cause, outcome = (part.split('"')[1] for part in sorted(labels.split(",")))
        values[outcome, cause] = float(value)
    return values


def test_failures_are_counted_by_cause_and_only_a_person_aborts(live: LiveService) -> None:
    before = counted(live)
    assert before["failed", "attempts"] == 0.0  # there from the start, or its first increase would not be seen
    assert before["regrasped", "afresh"] == 0.0
    meant = {"operator": "aborted", "probed": "probed", "afresh": "regrasped"}
    for number, cause in enumerate(("attempts", "unwatched", *meant, "attempts")):
        path = given_up(live, f"cause-{number}", cause)
        summary = json.loads((path.parent / "summary.json").read_text())
        assert summary["cause"] == cause
        assert summary["outcome"] == meant.get(cause, "failed")
    after = counted(live)
    grown = {key: after[key] - before.get(key, 0.0) for key in after if after[key] != before.get(key, 0.0)}
    once = {(outcome, cause): 1.0 for cause, outcome in meant.items()}
    assert grown == {("failed", "attempts"): 2.0, ("failed", "unwatched"): 1.0} | once
    listed = httpx.get(live.url("/v1/recordings")).json()["recordings"]
    assert {r["cause"] for r in listed if r["insertion_id"].startswith("cause-")} == {
        *("attempts", "unwatched", *meant)
    }
