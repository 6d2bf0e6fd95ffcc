import base64
import itertools
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import structlog

from service.cameras.capture import RETRY_S, Camera, CameraError, CameraFrame, Capture, now_ns
from service.cameras.recorded import RecordingSource
from service.cameras.sources import MjpegSource, PushSource, _Stream, open_source
from service.contract import TactileFrame
from tests.service.mjpeg import FakeFinger
from tests.waiting import wait_for

BLACK = np.zeros((4, 4, 3), np.uint8)


def collect(camera_url: str, seconds: float) -> tuple[list[CameraFrame], list[str]]:
    frames: list[CameraFrame] = []
    faults: list[str] = []
    camera = Camera("left", open_source(camera_url), frames.append, lambda _, code, __: faults.append(code))
    camera.start()
    time.sleep(seconds)
    camera.stop()
    return frames, faults


def test_mjpeg_frames_are_stamped_counted_and_keep_their_jpeg() -> None:
    finger = FakeFinger("left", 30)
    frames, faults = collect(finger.url, 1.0)
    finger.close()
    assert len(frames) >= 5
    assert [f.frame.seq for f in frames] == list(range(len(frames)))
    assert all(a.frame.captured_ns < b.frame.captured_ns for a, b in itertools.pairwise(frames))
    assert all(f.jpeg is not None and f.frame.pixels.shape == (320, 427, 3) for f in frames)
    assert faults == []


def test_a_camera_that_is_not_there_is_one_fault() -> None:
    frames, faults = collect("http://127.0.0.1:9/none", 0.8)
    assert (frames, faults) == ([], ["camera_lost"])


def test_an_unattended_camera_is_counted_in_full_and_decoded_now_and_then() -> None:
    jpeg = cv2.imencode(".jpg", np.zeros((8, 9, 3), np.uint8))[1].tobytes()
    frames: list[CameraFrame] = []
    attended = False
    camera = Camera("left", PushSource(), frames.append, lambda *_: None, lambda: attended)
    for stamp_ns in range(1, 41):
        camera._publish(Capture(stamp_ns, None, jpeg + bytes([stamp_ns])))
    assert (camera.frames_n, camera.newest_ns, camera.state) == (40, 40, "live")
    assert len(frames) == 10
    attended = True
    for stamp_ns in range(41, 51):
        camera._publish(Capture(stamp_ns, None, jpeg + bytes([stamp_ns])))
    assert [frame.frame.captured_ns for frame in frames[10:]] == list(range(41, 51))
    assert [frame.frame.seq for frame in frames] == list(range(20))


def test_a_few_broken_pictures_are_left_out_and_ten_in_a_row_are_a_lost_camera() -> None:
    camera = Camera("left", PushSource(), lambda _: None, lambda *_: None)
    for stamp_ns in range(9):
        camera._publish(Capture(stamp_ns, None, b"no pict%d" % stamp_ns))
    assert camera.latest is None
    with pytest.raises(CameraError, match="10 bytes are not a JPEG"):
        camera._publish(Capture(9, None, b"no picture"))


@pytest.mark.parametrize("stated_px", [None, b"\xff\xdc\xff\xdc"])
def test_a_picture_that_is_empty_or_states_an_impossible_size_is_broken_like_any_other(stated_px: bytes | None) -> None:
    whole = cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes()
    size = whole.index(b"\xff\xc0") + 5
    broken = b"" if stated_px is None else whole[:size] + stated_px + whole[size + 4 :]
    camera = Camera("left", PushSource(), lambda _: None, lambda *_: None)
    for stamp_ns, jpeg in enumerate((whole, broken, whole)):
        camera._publish(Capture(stamp_ns, None, jpeg))
    assert camera.latest is not None
    assert (camera.state, camera.latest.frame.captured_ns) == ("live", 2)


class Endless:
    """An answer whose parts have no header that ends."""

    read_n = 0

    def read1(self, size: int) -> bytes:
        self.read_n += size
        assert self.read_n < 1 << 24, "it would go on until the memory is full"
        return b"x\n" * (size // 2)


def test_a_stream_without_the_end_of_a_header_is_a_fault_and_no_memory_leak() -> None:
    source = MjpegSource("http://127.0.0.1:9/")
    with pytest.raises(CameraError, match="without the end of a part's header"):
        next(source._parse(_Stream(Endless(), None), b"--frame", threading.Event()))


def test_user_and_password_of_an_address_are_sent_and_not_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    heard: list[str] = []
    finger = FakeFinger("left", 30)
    served = finger.serve
    monkeypatch.setattr(finger, "serve", lambda one: (heard.append(one.headers["Authorization"]), served(one)))
    source = MjpegSource(finger.url.replace("//", "//operator:p%40ss@"))
    next(source.frames(threading.Event()))
    finger.close()
    assert heard == [f"Basic {base64.b64encode(b'operator:p@ss').decode()}"]
    assert "p%40ss" not in source.name


def test_a_changed_size_is_a_fault() -> None:
    finger = FakeFinger("left", 30)
    faults: list[str] = []
    camera = Camera("left", MjpegSource(finger.url), lambda _: None, lambda *fault: faults.append(fault[2]))
    camera.start()
    wait_for(lambda: camera.latest)
    finger.size = (640, 480)
    wait_for(lambda: faults)
    camera.stop()
    finger.close()
    assert faults == ["left frames changed from 427 x 320 to 640 x 480"]


def test_a_silent_camera_is_stalled() -> None:
    source = PushSource()
    faults: list[str] = []
    camera = Camera("left", source, lambda _: None, lambda *fault: faults.append(fault[1]))
    camera.start()
    source.push(TactileFrame("left", 0, 0, BLACK))
    wait_for(lambda: camera.latest)
    camera.check_stall(now_ns())
    assert camera.state == "live"
    camera.check_stall(now_ns() + 600_000_000)
    camera.check_stall(now_ns() + 900_000_000)
    camera.stop()
    assert (camera.state, faults) == ("stalled", ["camera_stalled"])


def still(camera_of: str, n: int) -> list[Capture]:
    """The same picture n times, each with a new stamp."""
    picture = np.full((8, 9, 3), 7, np.uint8)
    jpeg = cv2.imencode(".jpg", picture)[1].tobytes()
    return [Capture(i + 1, None if camera_of == "jpeg" else picture.copy(), jpeg) for i in range(n)]


@pytest.mark.parametrize("kind", ["jpeg", "pixels"])
def test_a_picture_that_comes_again_and_again_is_a_frozen_camera(kind: str) -> None:
    frames: list[CameraFrame] = []
    faults: list[tuple[str, str]] = []
    camera = Camera("left", PushSource(), frames.append, lambda _, code, detail: faults.append((code, detail)))
    for capture in still(kind, 20):
        camera._publish(capture)
    assert (len(frames), camera.state) == (1, "live")
    camera.check_stall(600_000_000)
    camera.check_stall(900_000_000)
    assert faults == [("camera_frozen", "the same picture 20 times for 0.5 s from push:")]
    assert camera.state == "stalled"
    with structlog.testing.capture_logs() as lines:
        camera._publish(Capture(10**9, np.full((8, 9, 3), 8, np.uint8)))
        camera._publish(Capture(10**9 + 1, np.full((8, 9, 3), 9, np.uint8)))
    assert (len(frames), camera.state) == (3, "live")
    assert [(line["finger"], line["code"]) for line in lines] == [("left", "live_again")], "once"


def test_pictures_that_arrive_late_are_a_stall_that_says_so_until_they_are_fresh() -> None:
    frames: list[CameraFrame] = []
    faults: list[tuple[str, str]] = []
    camera = Camera("left", PushSource(), frames.append, lambda _, code, detail: faults.append((code, detail)))
    for frame in range(60):
        camera._publish(Capture(1 + frame * 33_000_000, np.full((8, 9, 3), frame, np.uint8)))
        camera.check_stall(620_000_000 + frame * 33_000_000)
    assert faults == [("camera_stalled", "pictures from push: arrive 0.6 s late")]
    assert (camera.state, camera.frames_n) == ("stalled", 60)
    camera._publish(Capture(620_000_000 + 60 * 33_000_000, BLACK))
    assert camera.state == "live"


def test_a_stamp_that_does_not_advance_is_no_new_frame() -> None:
    frames: list[CameraFrame] = []
    camera = Camera("left", PushSource(), frames.append, lambda *_: None)
    for stamp_ns, grey in ((5, 1), (5, 2), (4, 3), (6, 4)):
        camera._publish(Capture(stamp_ns, np.full((8, 9, 3), grey, np.uint8)))
    assert [(f.frame.captured_ns, int(f.frame.pixels[0, 0, 0])) for f in frames] == [(5, 1), (6, 4)]


def test_a_source_that_fails_is_tried_again_four_times_a_second() -> None:
    """Reconnection within 1 s of return follows: 0.25 s between tries, each with a time limit of 1 s or less."""
    assert RETRY_S <= 0.25
    tries: list[float] = []

    class Flaky:
        name = "flaky"

        def frames(self, stop: threading.Event) -> Iterator[Capture]:
            tries.append(time.monotonic())
            if len(tries) < 4:
                raise OSError("unplugged")
            yield Capture(now_ns(), BLACK)
            stop.wait(5)

    faults: list[str] = []
    camera = Camera("left", Flaky(), lambda _: None, lambda _, code, __: faults.append(code))
    camera.start()
    wait_for(lambda: camera.state == "live")
    camera.stop()
    assert faults == ["camera_lost"]
    assert all(b - a >= RETRY_S for a, b in itertools.pairwise(tries))


def push(source: PushSource, grey: int) -> None:
    source.push(TactileFrame("left", grey, 0, np.full((4, 4, 3), grey, np.uint8)))


def shown(capture: Capture) -> int:
    return int(capture.image()[0, 0, 0])


def test_of_pushed_frames_that_wait_the_newest_is_kept_and_one_client_pushes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.cameras.silence.SILENT_S", 30.0)  # of a busy machine
    source = PushSource()
    captures = source.frames(threading.Event())
    for first in (0, 10):
        for grey in range(first, first + 10):
            push(source, grey)
        assert shown(next(captures)) == first + 9
    assert (source.claim(), source.claim()) == (True, False)
    source.release()
    assert source.claim()


def test_after_a_silence_pushed_frames_are_refused_until_their_client_has_connected_again() -> None:
    """They are stamped when they arrive, and may have waited on the way by as much as nothing came."""
    source = PushSource()
    captures = source.frames(threading.Event())
    assert source.claim()
    push(source, 0)
    assert shown(next(captures)) == 0
    time.sleep(0.25)
    for grey in (1, 2):
        with pytest.raises(CameraError, match=r"nothing was read for 0\.\d s: without stamps, what waited may be old"):
            push(source, grey)
    source.release()
    assert source.claim()
    push(source, 3)
    with pytest.raises(CameraError, match="what waited may be old"):
        next(captures)
    push(source, 4)
    assert shown(next(source.frames(threading.Event()))) == 4, "to the camera, which is opened again, it is a first one"


def test_a_client_that_pushes_without_a_gap_is_never_silent_however_late_its_frames_are_read(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stamps = itertools.count(0, 33_000_000)
    monkeypatch.setattr("service.cameras.sources.now_ns", lambda: next(stamps))
    source = PushSource()
    captures = source.frames(threading.Event())
    for reconnects in (False, True):
        assert source.claim()
        push(source, 1)
        assert shown(next(captures)) == 1
        for _ in range(30):
            push(source, 2)
        assert shown(next(captures)) == 2, f"connected again: {reconnects}"
        source.release()


def test_a_recording_plays_and_an_absent_one_says_so(tmp_path: Path) -> None:
    for index in range(3):
        cv2.imwrite(str(tmp_path / f"{index}.png"), np.full((8, 9, 3), index, np.uint8))
    stop = threading.Event()
    source = RecordingSource(tmp_path)
    levels = []
    for capture in source.frames(stop):
        levels.append(int(capture.pixels[0, 0, 0]))
        if len(levels) == 4:
            stop.set()
    assert levels == [0, 1, 2, 0]
    with pytest.raises(CameraError, match="does not exist"):
        RecordingSource(tmp_path / "none")


@pytest.mark.parametrize(
    ("url", "why"),
    [
        *((url, r": expected http://HOST:PORT/PATH, v4l2:N, file:PATH or push:") for url in ("ftp://x", "left", "")),
        ("http://", " names no host"),
    ],
)
def test_an_unknown_camera_is_named_with_the_accepted_forms(url: str, why: str) -> None:
    with pytest.raises(CameraError, match=f"camera '{url}'{why}"):
        open_source(url)
