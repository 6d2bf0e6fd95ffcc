"""Recording failures: the list still answers, readiness and a metric report them, and no frame is lost silently."""

import contextlib
import errno
import fcntl
import json
import os
import resource
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import IO

import httpx
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from service import __main__ as entry
from service.contract import FINGERS, TactileFrame, encode_frame, wire
from service.recordings.reader import Recording
from service.recordings.retention import make_room
from service.recordings.writer import FINAL, Recorder
from service.session.station import Station
from service.settings import Settings
from tests.service.client import greeted
from tests.service.conftest import LiveService, bearer, live_service, served
from tests.service.perception.synthetic import draw, grid
from tests.service.process import ServiceProcess, service_process
from tests.waiting import wait_for


@pytest.fixture
def own(tmp_path: Path, models_folder: Path) -> Iterator[LiveService]:
    with live_service(tmp_path, models_folder) as service:
        yield service


def inserted(live: LiveService, name: str) -> Path:
    driver = greeted(live, name)
    finished = driver.insert(1)
    driver.close()
    return Path(finished.recording).parent


def listed(live: LiveService) -> tuple[list[str], list[str]]:
    answer = httpx.get(live.url("/v1/recordings"))
    assert answer.status_code == 200
    return [r["insertion_id"] for r in answer.json()["recordings"]], answer.json()["problems"]


def metric(url: str, name: str) -> float:
    (line,) = [line for line in httpx.get(url).text.splitlines() if line.startswith(f"{name} ")]
    return float(line.split(" ")[1])


def test_one_bad_recording_is_named_and_the_others_are_listed(own: LiveService) -> None:
    good, bad = inserted(own, "good"), inserted(own, "bad")
    for content in (b"", b"[]", b"null", b'{"outcome": 3}', b"{" * 9, b"\xff", b'{"attempts": 1}'):
        (bad / "summary.json").write_bytes(content)
        names, problems = listed(own)
        assert names == ["good"], content
        assert [problem.startswith(f"{bad.name}: summary.json: ") for problem in problems] == [True], content
    assert httpx.get(own.url(f"/v1/recordings/{good.name}")).status_code == 200


def test_a_recording_that_a_power_cut_has_damaged_is_refused_with_the_reason(own: LiveService) -> None:
    path = inserted(own, "damaged") / FINAL
    whole, base = path.read_bytes(), own.url(f"/v1/recordings/{path.parent.name}")
    for content in (b"", whole[:40], whole[: len(whole) // 2], whole[:-300] + b"\xff" * 64 + whole[-236:]):
        path.write_bytes(content)
        for method, what in (("GET", "timeline"), ("GET", "moments/left/1"), ("POST", "decide")):
            answer = httpx.request(method, f"{base}/{what}")
            assert answer.status_code == 400, what
            assert len(answer.json()["error"]) > len("the recording cannot be read: ")


def test_a_recording_that_was_broken_off_is_named(own: LiveService) -> None:
    folder = inserted(own, "broken-off")
    (folder / "summary.json").unlink()
    assert listed(own)[1] == [f"{folder.name}: broken off; the next start of the service recovers what can be read"]


def test_a_recording_that_is_being_written_is_no_problem(own: LiveService) -> None:
    driver = greeted(own, "under-way")
    assert listed(own) == ([], [])
    finished = driver.insert(1)
    assert finished.outcome == "inserted", finished
    driver.close()


def test_who_lists_recordings_as_one_begins_keeps_nothing_from_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To see whether it is written, the list locks it for a moment, which may be the one before the writer does."""

    def listed_meanwhile(stream: IO[bytes], how: int) -> None:
        looking = os.open(stream.name, os.O_RDONLY)
        fcntl.flock(looking, fcntl.LOCK_EX | fcntl.LOCK_NB)
        threading.Timer(0.05, os.close, [looking]).start()
        fcntl.flock(stream, how)

    late = SimpleNamespace(flock=listed_meanwhile, LOCK_EX=fcntl.LOCK_EX, LOCK_NB=fcntl.LOCK_NB)
    monkeypatch.setattr("service.recordings.writer.fcntl", late)
    assert Recorder(tmp_path, "begins", {}).close({"outcome": "failed", "attempts": 0}).is_file()


def test_an_old_recording_that_cannot_be_removed_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As of another user, from before the service ran in a container: the disk fills up beyond its limit."""

    def refused(name: str, **_: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", name)

    for name in ("one", "two"):
        Recorder(tmp_path, name, {}).close({"outcome": "inserted", "attempts": 1})
    with monkeypatch.context() as of_another_user:
        of_another_user.setattr(os, "unlink", refused)
        assert make_room(tmp_path, 4).startswith("no old recording can be removed: Permission denied: ")
    assert make_room(tmp_path, 4) == ""
    assert [path.name.partition("_")[2] for path in tmp_path.iterdir()] == ["two"]


def test_a_missing_folder_is_named_everywhere_and_comes_back(own: LiveService) -> None:
    shutil.rmtree(own.recordings)
    assert listed(own) == ([], [f"{own.recordings}: No such file or directory"])
    ready = httpx.get(own.url("/readyz"))
    assert (ready.status_code, ready.json()["recording"]) == (503, f"the folder {own.recordings} is missing")
    assert metric(own.url("/metrics"), "tactile_recording_ok") == 0.0
    assert metric(own.url("/metrics"), "tactile_ready") == 1.0
    assert inserted(own, "after").is_dir()
    assert httpx.get(own.url("/readyz")).json()["recording"] == "ok"
    assert listed(own) == (["after"], [])


def test_a_second_service_does_not_share_the_recordings_of_the_first(
    own: LiveService, models_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    second = ["--models", str(models_folder), "--camera-left", "push:", "--camera-right", "push:", "--port", "0"]
    second += ["--recordings", str(own.recordings), "--state", str(tmp_path / "second")]
    capsys.readouterr()
    assert entry.main(["run", *second]) == 2
    why = f"another service keeps its recordings in {own.recordings}; give each its own --recordings"
    assert capsys.readouterr().err.strip() == f"service run: {why}"
    assert inserted(own, "goes-on").is_dir()


def test_a_stopped_service_leaves_its_recordings_to_the_next(tmp_path: Path, models_folder: Path) -> None:
    with live_service(tmp_path, models_folder) as first:
        folder = inserted(first, "first")
    with live_service(tmp_path, models_folder) as second:
        assert listed(second) == (["first"], [])
        assert folder.is_dir()


def test_a_disk_that_is_nearly_full_is_said_before_it_is_full(
    own: LiveService, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.recordings.retention.MIN_FREE_BYTES", 1 << 60)
    assert "MiB left" in httpx.get(own.url("/readyz")).json()["recording"]
    assert metric(own.url("/metrics"), "tactile_recording_ok") == 0.0


@contextlib.contextmanager
def pushed(service: str, token: dict[str, str], grids: dict[str, tuple[int, int]]) -> Iterator[Callable[[], None]]:
    """Two pushed cameras, and a function that shows the next frame of both; every picture is different.

    A service that was shown nothing for long closes the connection, and is shown the frame on another.
    """
    rng, seq = np.random.default_rng(0), iter(range(10_000))
    pictures = {
        finger: [draw(grid(rows, columns, pitch=15.0), rng) for _ in range(6)]
        for finger, (rows, columns) in grids.items()
    }
    with contextlib.ExitStack() as stack:

        def connected(finger: str) -> ClientConnection:
            url = f"{service}/v1/cameras/{finger}/push"
            return stack.enter_context(connect(url, additional_headers=token, compression=None))

        links = {finger: connected(finger) for finger in FINGERS}

        def show() -> None:
            number = next(seq)
            for finger in FINGERS:
                frame = encode_frame(TactileFrame(finger, number, 0, pictures[finger][number % 6]))
                try:
                    links[finger].send(frame)
                except ConnectionClosed:
                    links[finger] = connected(finger)
                    links[finger].send(frame)

        yield show


def test_different_grids_on_two_fingers_are_refused_by_name_and_every_frame_is_kept(
    tmp_path: Path, models_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.cameras.silence.SILENT_S", 30.0)  # of a busy machine
    settings = Settings(
        models=models_folder,
        camera_left="push:",
        camera_right="push:",
        recordings=tmp_path / "r",
        state=tmp_path / "state",
        reference_timeout_s=3.0,
        max_frame_age_ms=60_000.0,
    )
    with served(settings) as (station, port):
        base, token = f"ws://127.0.0.1:{port}", bearer(station)
        with pushed(base, token, {"left": (20, 21), "right": (16, 17)}) as show:
            fault, shown, path = refused(base, token, station, show)
    assert (fault.type, fault.reason) == ("refused", "no_reference")
    assert "the fingers show different grids: left 21 x 20 markers, right 17 x 16" in fault.detail
    assert station.counters.perception_errors_n == 0
    recording = Recording(path)
    for finger in FINGERS:
        assert len(recording.frames(finger)) >= shown
    assert json.loads((path.parent / "summary.json").read_text())["left_out_n"] == 0


def refused(
    base: str, token: dict[str, str], station: Station, show: Callable[[], None]
) -> tuple[wire.Refused, int, Path]:
    """Ask for a reference until it is refused; the refusal, the number of pairs shown meanwhile, and the recording."""
    with connect(f"{base}/v1/insertion", additional_headers=token, compression=None) as link:
        link.send(wire.ClientHello(insertion_id="unlike", client="test").model_dump_json())
        assert wire.parse_service(link.recv(20)).type == "hello"
        show()
        link.send(
            wire.Arm(insertion_id="unlike", attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0).model_dump_json()
        )
        shown, fault = 0, None
        while fault is None:
            show()
            shown += 1
            with contextlib.suppress(TimeoutError):
                fault = wire.parse_service(link.recv(0.1))
        recorded = station.active.recorder
        link.send(wire.Abort(insertion_id="unlike", cause="operator", reason="done").model_dump_json())
        while wire.parse_service(link.recv(20)).type != "finished":
            pass
    # frames may be captured before the arm is heard, and one pair may still be under way when the fault comes
    return fault, shown - 3, recorded.path


def limited(service: ServiceProcess, bytes_n: int) -> None:
    """Limit the size of the process's files: the effect of a full disk, on this process alone."""
    resource.prlimit(service.process.pid, resource.RLIMIT_FSIZE, (bytes_n, resource.RLIM_INFINITY))


def test_a_full_disk_is_said_while_it_is_full_and_the_insertion_ends_as_it_should(
    tmp_path: Path, models_folder: Path
) -> None:
    cameras = ["--camera-left", "push:", "--camera-right", "push:", "--camera-wait-s", "0"]
    cameras += ["--reference-timeout-s", "30", "--max-frame-age-ms", "60000", "--client-timeout-s", "60"]
    with service_process(models_folder, tmp_path / "r", *cameras) as service:
        base, token = service.url("", "ws"), service.bearer
        with (
            pushed(base, token, dict.fromkeys(FINGERS, (20, 21))) as show,
            connect(f"{base}/v1/insertion", additional_headers=token, compression=None) as link,
        ):
            show()
            link.send(wire.ClientHello(insertion_id="full", client="test").model_dump_json())
            assert wire.parse_service(link.recv(20)).type == "hello"
            limited(service, 1 << 16)
            arm = wire.Arm(insertion_id="full", attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0)
            link.send(arm.model_dump_json())
            until = time.monotonic() + 60
            while "File too large" not in httpx.get(service.url("/readyz")).json()["recording"]:
                show()
                assert time.monotonic() < until
            assert metric(service.url("/metrics"), "tactile_recording_ok") == 0.0
            link.send(wire.Abort(insertion_id="full", cause="operator", reason="done").model_dump_json())
            while wire.parse_service(link.recv(20)).type != "finished":
                show()
        wait_for(lambda: metric(service.url("/metrics"), "tactile_insertions_unrecorded") == 1.0)
        answer = httpx.get(service.url("/v1/recordings")).json()
        assert len(answer["recordings"]) + len(answer["problems"]) == 1
        limited(service, resource.RLIM_INFINITY)
        assert httpx.get(service.url("/readyz")).json()["recording"] == "ok", "the next one can be recorded"
        assert metric(service.url("/metrics"), "tactile_recording_ok") == 0.0, "the last one was not"
        assert "File too large" in httpx.get(service.url("/v1/status")).json()["health"]["recording"]
    assert "File too large" in "".join(service.log)
