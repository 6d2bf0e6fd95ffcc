import errno
import fcntl
import json
import os
import signal
import subprocess
import sys
import textwrap
import threading
import tracemalloc
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader

from service import __main__ as entry
from service.cameras.capture import CameraFrame
from service.contract import TactileFrame, wire
from service.recordings.listing import list_recordings
from service.recordings.reader import Recording, RecordingError
from service.recordings.recovery import is_being_written, recover
from service.recordings.retention import largest_bytes, make_room, prune
from service.recordings.writer import Recorder
from tests.service import drawn
from tests.service.client import greeted
from tests.service.conftest import LiveService


def test_a_recorded_insertion_is_decided_again_bit_for_bit(
    live: LiveService, models_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    driver = greeted(live, "again")
    driver.attempt(1)
    driver.attempt(2)
    path = driver.insert(3).recording
    driver.close()
    assert path is not None
    assert entry.main(["replay", path, "--models", str(models_folder)]) == 0
    assert "all the same bit for bit" in capsys.readouterr().out
    recording = Recording(Path(path))
    assert recording.complete
    assert len(recording.of("/left/markers")) > 20
    kinds = [e.json()["message"]["type"] for e in recording.of("/messages") if e.json()["from"] == "service"]
    assert kinds.count("watching") > 20
    answers = [kind for kind in kinds if kind != "watching"]
    assert answers == ["hello", *["armed", "slip", "correction"] * 2, "armed", "finished"]


def test_recorded_markers_are_read_with_the_schema_that_lies_beside_them(tmp_path: Path) -> None:
    """By a pool that knows only the file."""
    observation = drawn.watch().observe(TactileFrame("left", 7, 123_456_789, drawn.raw("left", 0, 10, 16)))
    recorder = Recorder(tmp_path, "markers", {})
    recorder.observation(observation)
    with recorder.close({}).open("rb") as stream:
        ((schema, _, recorded),) = make_reader(stream).iter_messages()
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
        pool.Add(file)
    assert schema.name == "tactile_insertion.Markers"
    message = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name)).FromString(recorded.data)
    field = observation.field
    assert (message.seq, message.rows, message.cols) == (7, *field.valid.shape)
    assert message.timestamp.ToNanoseconds() == recorded.log_time
    np.testing.assert_array_equal(np.reshape(message.rest_px, field.rest_px.shape), field.rest_px.astype(np.float32))
    assert message.valid == field.valid.astype(np.uint8).tobytes()
    assert message.state == observation.slip.state


def test_raw_frames_come_back_exactly(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (320, 427, 3), np.uint8)
    recorder = Recorder(tmp_path, "raw", {})
    recorder.frame(CameraFrame(TactileFrame("left", 5, 123_456_789, pixels), None))
    recorder.message("client", wire.Abort(insertion_id="raw", cause="operator", reason="x").model_dump(), 123_456_790)
    recording = Recording(recorder.close({"outcome": "aborted"}))
    frame = recording.frames("left")[5]
    assert frame.captured_ns == 123_456_789
    assert (frame.pixels == pixels).all()


KILLED = """
import os, signal, sys, time
from pathlib import Path
from service.recordings.writer import Recorder
recorder = Recorder(Path(sys.argv[1]), "killed", {})
for index in range(40):
    recorder.message("client", {"index": index}, time.monotonic_ns())
    time.sleep(0.05)
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_of_a_long_recording_few_pictures_fill_memory_at_once(tmp_path: Path) -> None:
    flat = np.full((320, 427, 3), 90, np.uint8)
    jpeg = cv2.imencode(".jpg", flat)[1].tobytes()
    recorder = Recorder(tmp_path, "long", {})
    for index in range(100):
        recorder.frame(CameraFrame(TactileFrame("left", index, index + 1, flat), jpeg))
    path = recorder.close({"outcome": "failed", "attempts": 0})
    tracemalloc.start()
    shown = [frame.seq for frame in Recording(path).frames("left").values()]
    _, most_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert shown == list(range(100))
    assert most_bytes < 10 * flat.nbytes


def test_a_killed_service_leaves_all_but_the_last_second(tmp_path: Path) -> None:
    code = subprocess.run([sys.executable, "-c", textwrap.dedent(KILLED), str(tmp_path)], check=False).returncode
    assert code == -signal.SIGKILL
    (path,) = tmp_path.glob("*_killed/insertion.mcap.part")
    recording = Recording(path)
    assert not recording.complete
    indices = [e.json()["message"]["index"] for e in recording.of("/messages")]
    assert indices == list(range(len(indices)))
    assert len(indices) >= 20
    (whole,) = recover(tmp_path)
    again = Recording(whole)
    assert (again.complete, again.recovered) == (True, True)
    assert [e.json()["message"]["index"] for e in again.of("/messages")] == indices
    assert again.metadata == recording.metadata
    summary = json.loads((whole.parent / "summary.json").read_text())
    assert (summary["insertion_id"], summary["outcome"]) == ("killed", "interrupted")
    assert list(tmp_path.glob("*/*.part")) == recover(tmp_path) == []


def test_all_files_are_on_the_disk_before_the_recording_has_its_final_name(tmp_path: Path, monkeypatch) -> None:
    """A power cut later than that shortens none of them."""
    recorder, on_disk, names, really = Recorder(tmp_path, "cut", {}), {}, set(), os.fsync

    def fsync(number: int) -> None:
        assert not recorder.path.exists()
        really(number)
        on_disk[os.fstat(number).st_ino] = os.fstat(number).st_size
        names.add(Path(f"/proc/self/fd/{number}").resolve().name)

    monkeypatch.setattr(os, "fsync", fsync)
    recorder.message("client", {"type": "hello"}, 1)
    recorder.attempt(1, lambda: {"steps": np.zeros(3)})
    files = {file.name: file.stat() for file in recorder.close({"outcome": "inserted"}).parent.iterdir()}
    assert set(files) >= {"insertion.mcap", "summary.json", "attempt_01.npz"}
    assert on_disk.pop(recorder.folder.stat().st_ino), "nor does it take a name back"
    assert {file.st_ino: file.st_size for file in files.values()} == on_disk
    assert f".attempt_01.npz.{os.getpid()}.tmp" in names, "nor does one earlier cost an attempt that is over"


def test_a_recording_that_is_being_written_is_left_alone(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, "alive", {})
    assert recover(tmp_path) == []
    assert Recording(recorder.close({"outcome": "aborted"})).recovered is False


def test_a_part_that_holds_nothing_is_put_aside_and_not_tried_again(tmp_path: Path) -> None:
    folder = tmp_path / "20260101T000000_x"
    folder.mkdir()
    (folder / "insertion.mcap.part").write_bytes(os.urandom(1000))
    assert "the next start of the service recovers" in list_recordings(tmp_path)[1][0]
    assert recover(tmp_path) == []
    assert [path.name for path in folder.iterdir()] == ["insertion.mcap.unreadable"]
    assert "before there was anything to read; remove it" in list_recordings(tmp_path)[1][0]


def test_the_disk_use_of_recordings_is_bounded_while_one_is_written(tmp_path: Path) -> None:
    bound = 4_000_000
    noise = np.random.default_rng(0).integers(0, 255, (320, 427, 3), np.uint8)
    for insertion in range(6):
        make_room(tmp_path, bound)
        recorder = Recorder(tmp_path, f"i{insertion}", {}, largest_bytes(bound))
        for index in range(10):
            recorder.frame(CameraFrame(TactileFrame("left", index, index + 1, noise), None))
        recorder.close({"outcome": "failed"})
        assert recorder.left_out_n > 0
        assert sum(file.stat().st_size for file in tmp_path.rglob("*.*")) < bound
    assert len(list(tmp_path.iterdir())) >= 2


def test_garbage_is_no_recording(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no recording at"):
        Recording(tmp_path / "none.mcap")
    (tmp_path / "x.mcap").write_bytes(os.urandom(1000))
    with pytest.raises(RecordingError, match="no readable MCAP"):
        Recording(tmp_path / "x.mcap")


def test_a_full_disk_is_not_littered_with_folders_of_insertions_of_which_it_took_nothing(tmp_path: Path) -> None:
    Recorder(tmp_path, "whole", {}).close({"outcome": "inserted", "attempts": 1})
    for name in ("20990101T000000_a", "20990101T000001_b", "20990101T000002_c"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "insertion.mcap.part").touch()
    recover(tmp_path)
    make_room(tmp_path, 1 << 30)
    listed, problems = list_recordings(tmp_path)
    assert [one["insertion_id"] for one in listed] == ["whole"]
    assert problems == ["20990101T000002_c: broken off before there was anything to read; remove it"]


def test_folders_that_are_no_recordings_never_make_room(tmp_path: Path) -> None:
    for name in (".git", "20250101", "20250101T000000_a", "20260101T000000_b", "photos"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "content").write_bytes(b"\0" * 1000)
    assert [path.name for path in prune(tmp_path, 1500)] == ["20250101T000000_a"]
    assert sorted(path.name for path in tmp_path.iterdir()) == [".git", "20250101", "20260101T000000_b", "photos"]


def test_a_share_that_locks_only_what_is_open_for_writing_has_its_recordings_recovered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As NFS does, see flock(2)."""
    lock, folder = fcntl.flock, Recorder(tmp_path, "whole", {}).close({"outcome": "inserted", "attempts": 1}).parent
    (folder / "insertion.mcap").rename(folder / "insertion.mcap.part")

    def flock(stream: Any, how: int) -> None:
        if not stream.writable():
            raise OSError(errno.EBADF, "Bad file descriptor")
        lock(stream, how)

    monkeypatch.setattr(fcntl, "flock", flock)
    alive = Recorder(tmp_path, "alive", {})
    recovered = [whole.parent for whole in recover(tmp_path)], is_being_written(next(tmp_path.glob("*_alive")))
    alive.close({"outcome": "aborted"})
    assert recovered == ([folder], True)


def test_a_recording_that_cannot_be_recovered_stays_as_it_is_and_stops_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "insertion.mcap.part").write_bytes(b"\0" * 1000)

    def disk_is_full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("service.recordings.recovery._copy", disk_is_full)
    assert recover(tmp_path) == []
    parts = ["a/insertion.mcap.part", "b/insertion.mcap.part"]
    assert sorted(str(path.relative_to(tmp_path)) for path in tmp_path.glob("*/*")) == parts


def test_a_part_on_a_disk_that_is_read_only_now_stops_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "insertion.mcap.part").write_bytes(b"\0" * 1000)
    really = Path.open

    def read_only(path: Path, mode: str = "r", **more: object) -> object:
        if mode == "rb":
            return really(path, mode)
        return refused(path)

    def refused(path: Path, **_: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system", str(path))

    monkeypatch.setattr(Path, "open", read_only)
    monkeypatch.setattr(Path, "unlink", refused)
    assert recover(tmp_path) == []


def test_a_part_that_cannot_even_be_opened_stops_nothing(tmp_path: Path) -> None:
    (tmp_path / "x" / "insertion.mcap.part").mkdir(parents=True)
    assert recover(tmp_path) == []


def test_an_insertion_that_is_removed_meanwhile_makes_no_trouble_for_the_next_one(tmp_path: Path) -> None:
    for number in range(100):  # measured first, so that the last one has time to go
        (tmp_path / f"20250101T000000_{number}").mkdir()
    folder, ended = tmp_path / "20260101T000000_a", threading.Event()

    def come_and_go() -> None:
        while not ended.is_set():
            folder.mkdir()
            folder.rmdir()

    thread = threading.Thread(target=come_and_go)
    thread.start()
    try:
        for _ in range(50):
            make_room(tmp_path, 1 << 30)
    finally:
        ended.set()
        thread.join()


@pytest.mark.parametrize("newest", ["20990228T235959999999_far", "20260101T000000_short"])
def test_a_recording_made_after_the_clock_was_set_back_is_still_the_newest(tmp_path: Path, newest: str) -> None:
    (tmp_path / newest).mkdir()
    (tmp_path / newest / "insertion.mcap").write_bytes(b"\0" * 1000)
    paths = [Recorder(tmp_path, name, {}).close({"outcome": "failed", "attempts": 1}) for name in ("one", "two")]
    listed, _ = list_recordings(tmp_path)
    assert [one["insertion_id"] for one in listed] == ["two", "one"]
    prune(tmp_path, 0)
    assert [path.name for path in tmp_path.iterdir()] == [paths[-1].parent.name]


def test_a_folder_whose_stamp_is_no_time_keeps_nothing_from_being_recorded(tmp_path: Path) -> None:
    (tmp_path / "99999999T999999_x").mkdir()
    assert Recorder(tmp_path, "one", {}).close({"outcome": "failed", "attempts": 1}).is_file()
