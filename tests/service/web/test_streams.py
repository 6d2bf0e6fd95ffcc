"""Frames in by WebSocket, out by WebSocket and MJPEG, while the same service decides."""

import collections
import contextlib
import itertools
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import httpx
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from service.contract import FINGERS, Finger, TactileFrame, decode_frame, encode_frame
from service.session.station import Station
from service.settings import Settings
from tests.service.client import greeted
from tests.service.conftest import LiveService, bearer, served
from tests.service.process import service_process
from tests.waiting import wait_for


@pytest.fixture
def pushed(tmp_path: Path, models_folder: Path) -> Iterator[tuple[Station, str, dict[str, str]]]:
    """A service with pushed cameras, its address, and the authorising header."""
    settings = Settings(models=models_folder, camera_left="push:", camera_right="push:", recordings=tmp_path / "r")
    with served(settings) as (station, port):
        yield station, f"ws://127.0.0.1:{port}", bearer(station)


def picture(finger: Finger, seq: int) -> TactileFrame:
    pixels = np.random.default_rng(seq).integers(0, 255, (320, 327, 3), np.uint8)
    return TactileFrame(finger, seq, seq, pixels)


def test_what_is_pushed_in_comes_out_bit_for_bit(
    pushed: tuple[Station, str, dict[str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.cameras.silence.SILENT_S", 30.0)  # of a busy machine
    station, base, token = pushed
    for finger in FINGERS:
        with (
            connect(f"{base}/v1/cameras/{finger}/frames?max_hz=240", compression=None) as out,
            connect(f"{base}/v1/cameras/{finger}/push", additional_headers=token, compression=None) as into,
        ):
            for seq in range(3):
                into.send(encode_frame(picture(finger, seq)))
                frame = decode_frame(out.recv(20))
                assert (frame.finger, frame.seq) == (finger, seq)
                assert (frame.pixels == picture(finger, seq).pixels).all()
    assert [camera.state for camera in station.cameras.values()] == ["live", "live"]


def test_a_wrong_frame_closes_the_pushing_connection_with_the_reason(
    pushed: tuple[Station, str, dict[str, str]],
) -> None:
    _, base, token = pushed
    wrong = {
        b"junk": "binary frame of 4 bytes",
        encode_frame(picture("right", 0)): "a frame of the right finger, expected left",
        "text": "expected binary frames",
    }
    for message, reason in wrong.items():
        with connect(f"{base}/v1/cameras/left/push", additional_headers=token, compression=None) as into:
            into.send(message)
            with pytest.raises(ConnectionClosed) as closed:
                into.recv(20)
            assert closed.value.rcvd.code == 1003
            assert reason in closed.value.rcvd.reason


def test_one_client_pushes_a_camera(pushed: tuple[Station, str, dict[str, str]]) -> None:
    _, base, token = pushed
    with connect(f"{base}/v1/cameras/left/push", additional_headers=token, compression=None) as first:
        first.send(encode_frame(picture("left", 0)))
        with (
            connect(f"{base}/v1/cameras/left/push", additional_headers=token, compression=None) as second,
            pytest.raises(ConnectionClosed) as no,
        ):
            second.recv(20)
        assert "another client pushes the left camera" in no.value.rcvd.reason
        with connect(f"{base}/v1/cameras/right/push", additional_headers=token, compression=None) as other:
            other.send(encode_frame(picture("right", 0)))


def test_who_pushes_after_a_silence_is_sent_off_and_taken_again(
    pushed: tuple[Station, str, dict[str, str]],
) -> None:
    """What waited on the way passes for fresh on no connection; a new one has nothing that waits."""
    station, base, token = pushed
    camera, url = station.cameras["left"], f"{base}/v1/cameras/left/push"
    with connect(url, additional_headers=token, compression=None) as into:
        into.send(encode_frame(picture("left", 0)))
        wait_for(lambda: camera.frames_n == 1)
        time.sleep(0.25)
        into.send(encode_frame(picture("left", 1)))
        with pytest.raises(ConnectionClosed) as closed:
            into.recv(20)
    assert closed.value.rcvd.code == 1013
    assert "without stamps, what waited may be old" in closed.value.rcvd.reason
    assert camera.frames_n == 1
    seqs = itertools.count(100)
    while camera.frames_n == 1:  # a busy machine may be silent once more
        with contextlib.suppress(ConnectionClosed), connect(url, additional_headers=token, compression=None) as again:
            while camera.frames_n == 1:
                again.send(encode_frame(picture("left", next(seqs))))
                time.sleep(0.02)
    assert camera.state == "live"
    assert "without stamps, what waited may be old" in camera.last_fault, "whose insertion heard of it"


def test_a_camera_of_its_own_takes_no_pushed_frames(live: LiveService) -> None:
    with (
        connect(live.url("/v1/cameras/left/push", "ws"), additional_headers=live.bearer) as link,
        pytest.raises(ConnectionClosed) as closed,
    ):
        link.recv(20)
    assert "start the service with --camera-left push:" in closed.value.rcvd.reason


def test_a_reason_longer_than_a_close_frame_is_cut(tmp_path: Path, models_folder: Path) -> None:
    clip = tmp_path / ("ü" * 80)
    clip.mkdir()
    cameras = {"camera_left": f"file:{clip}", "camera_right": "push:"}
    places = {"models": models_folder, "recordings": tmp_path / "r", "state": tmp_path / "state"}
    with served(Settings(**places, **cameras)) as (station, port):
        url = f"ws://127.0.0.1:{port}/v1/cameras/left/push"
        with connect(url, additional_headers=bearer(station)) as link, pytest.raises(ConnectionClosed) as closed:
            link.recv(20)
    assert closed.value.rcvd.code == 1003
    assert closed.value.rcvd.reason.startswith("the left camera is ")


def test_a_slow_viewer_gets_the_newest_frame_and_skips_the_others(live: LiveService) -> None:
    with connect(live.url("/v1/cameras/right/frames?max_hz=2&form=jpeg", "ws"), compression=None) as out:
        pictures = [out.recv(20) for _ in range(3)]
    assert all(cv2.imdecode(np.frombuffer(p, np.uint8), cv2.IMREAD_COLOR).shape == (320, 427, 3) for p in pictures)


def test_mjpeg_streams_each_finger_and_says_how_many_viewers_it_takes(
    live: LiveService, monkeypatch: pytest.MonkeyPatch
) -> None:
    for finger in FINGERS:
        with httpx.stream("GET", live.url(f"/v1/cameras/{finger}/stream.mjpg"), timeout=30) as answer:
            assert answer.headers["content-type"].startswith("multipart/x-mixed-replace")
            received = b""
            for piece in answer.iter_bytes():
                received += piece
                if received.count(b"--frame") > 2:
                    break
        start = received.index(b"\r\n\r\n") + 4
        assert received[start : start + 2] == b"\xff\xd8"
    monkeypatch.setattr("service.web.routes.cameras.MAX_VIEWERS", 0)
    assert httpx.get(live.url("/v1/cameras/left/stream.mjpg")).status_code == 429
    with connect(live.url("/v1/cameras/left/frames", "ws")) as link, pytest.raises(ConnectionClosed) as closed:
        link.recv(20)
    assert closed.value.rcvd.code == 1013


@pytest.fixture
def heeds_its_terminal() -> Iterator[None]:
    """A service started under nohup goes on after SIGHUP, and the tests may have been started like that."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.usefixtures("heeds_its_terminal")
@pytest.mark.parametrize("asked", [signal.SIGTERM, signal.SIGHUP])  # the latter by a terminal that is closed
def test_a_service_that_stops_waits_for_no_viewer(
    live: LiveService, tmp_path: Path, models_folder: Path, asked: signal.Signals
) -> None:
    left, right = (f"--camera-{finger.finger}={finger.url}" for finger in live.fingers)
    calibration = f"--calibration={live.recordings.parent / 'calibration.toml'}"
    with service_process(models_folder, tmp_path / "recordings", left, right, calibration) as stopping:
        with (
            connect(stopping.url("/v1/insertion", "ws"), compression=None),
            httpx.stream("GET", stopping.url("/v1/cameras/left/stream.mjpg"), timeout=30) as answer,
        ):
            pieces = answer.iter_bytes()
            next(pieces)
            stopping.process.send_signal(asked)
            with contextlib.suppress(httpx.HTTPError):
                collections.deque(pieces, maxlen=0)
        assert stopping.process.wait(20) == 0
    log = "".join(stopping.log)
    assert "Traceback" not in log
    assert "reason='the service stops'" in log, "the client did not leave by itself"


def test_viewers_come_and_go_while_an_insertion_is_decided(live: LiveService) -> None:
    driver = greeted(live, "watched")
    links = [
        connect(live.url(f"/v1/cameras/{f}/frames?max_hz=240", "ws"), compression=None, close_timeout=0.1)
        for f in FINGERS
    ]
    with links[0], links[1]:
        driver.attempt(1)
    assert driver.insert(2).outcome == "inserted"
    driver.close()
