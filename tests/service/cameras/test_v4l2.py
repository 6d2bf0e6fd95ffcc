"""Video devices: by number or by a name that survives a reboot, absent, replugged, busy."""

import itertools
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from service.cameras.capture import CameraError, now_ns
from service.cameras.recorded import RecordingSource
from service.cameras.sources import open_source
from service.cameras.v4l2 import V4l2Source, serial_of

BY_ID = "/dev/v4l/by-id/usb-maker_camera_SN0001-video-index0"


class Device:
    """OpenCV's interface to a video device, frame by frame; a test machine has none."""

    def __init__(self, frames_n: int) -> None:
        self.left_n, self.set_to, self.released = frames_n, {}, False

    def isOpened(self) -> bool:
        return True

    def set(self, key: int, value: float) -> bool:
        self.set_to[key] = value
        return True

    def get(self, key: int) -> float:
        """The driver's stamp in ms, as `cv2.CAP_PROP_POS_MSEC` gives it: the picture waited for 80 ms."""
        assert key == cv2.CAP_PROP_POS_MSEC
        return self.read_ns / 1e6 - 80.0

    def read(self) -> tuple[bool, np.ndarray | None]:
        self.left_n -= 1
        self.read_ns = now_ns()
        return (self.left_n >= 0, np.full((4, 4, 3), self.left_n % 250, np.uint8) if self.left_n >= 0 else None)

    def release(self) -> None:
        self.released = True


def plugged(monkeypatch: pytest.MonkeyPatch, device: Device) -> list[tuple[str, int]]:
    """Let OpenCV open ``device`` by any name; returns the names that it was asked for."""
    opened: list[tuple[str, int]] = []
    monkeypatch.setattr(cv2, "VideoCapture", lambda name, backend: opened.append((name, backend)) or device)
    return opened


@pytest.mark.parametrize("url", ["/dev/video2", "v4l2:2"])
def test_a_video_device_gives_its_frames_and_is_given_back_when_unplugged(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    device = Device(5)
    opened = plugged(monkeypatch, device)
    source = open_source(url, frame_rate_hz=60.0)
    captures = list(source.frames(threading.Event()))
    assert (source.name, opened, len(captures)) == ("v4l2:2", [("/dev/video2", cv2.CAP_V4L2)], 5)
    assert all(a.captured_ns <= b.captured_ns for a, b in itertools.pairwise(captures))
    assert captures[-1].captured_ns == pytest.approx(device.read_ns - 80_000_000, abs=10_000_000), (
        "not when it was read"
    )
    assert device.set_to[cv2.CAP_PROP_FPS] == 60.0
    assert device.set_to[cv2.CAP_PROP_BUFFERSIZE] >= 2, "one is filled while the other is read"
    assert device.released


class WallClock(Device):
    """A driver that stamps with another clock than this machine's monotonic one."""

    def get(self, key: int) -> float:
        return super().get(key) + 1.7e12


@pytest.mark.parametrize(("kind", "lost"), [(Device, False), (WallClock, True)])
def test_after_a_silence_a_device_is_opened_again_unless_its_stamps_tell_how_old_its_pictures_are(
    kind: type[Device], lost: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The driver's buffers keep their pictures while nobody reads them."""
    device = kind(5)
    plugged(monkeypatch, device)
    captures = open_source("v4l2:2").frames(threading.Event())
    next(captures)
    time.sleep(0.25)
    if not lost:
        assert next(captures).captured_ns < device.read_ns
        return
    with pytest.raises(CameraError, match="without stamps, what waited may be old"):
        next(captures)
    assert device.released


@pytest.mark.parametrize("prefix", ["", "file:"])
def test_a_name_that_survives_a_reboot_is_followed_at_each_try(prefix: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The number behind it may be another one then, and before it is plugged in there is none."""
    source = open_source(prefix + BY_ID)
    assert (type(source), source.name) == (V4l2Source, BY_ID)
    with pytest.raises(CameraError, match=f"cannot open {BY_ID}: it is not there; is it plugged in"):
        next(iter(source.frames(threading.Event())))
    opened = plugged(monkeypatch, Device(1))
    assert len(list(source.frames(threading.Event()))) == 1
    assert opened == [(BY_ID, cv2.CAP_V4L2)]


def test_a_link_or_a_device_of_another_name_is_a_camera_and_no_recording(tmp_path: Path) -> None:
    """As a recording its pictures would be stamped when they are read. In a container a camera may have any name."""
    (tmp_path / "left").symlink_to("/dev/video63")
    (tmp_path / "pictures").mkdir()
    cv2.imwrite(str(tmp_path / "pictures" / "0.png"), np.zeros((8, 9, 3), np.uint8))
    assert type(open_source(str(tmp_path / "left"))) is V4l2Source
    assert type(open_source("/dev/null")) is V4l2Source
    assert type(open_source(str(tmp_path / "pictures"))) is RecordingSource


def test_an_absent_video_device_says_so_and_opencv_says_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(CameraError, match="cannot open /dev/video63: it is not there; is it plugged in"):
        next(iter(open_source("v4l2:63").frames(threading.Event())))
    with pytest.raises(CameraError, match="cannot open /dev/null: is it a camera, and free"):
        next(iter(open_source("/dev/null").frames(threading.Event())))
    assert capfd.readouterr() == ("", "")


def test_a_device_that_opens_and_gives_no_picture_says_what_may_keep_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """As two cameras on one USB controller do, where the second finds no room."""
    device = Device(0)
    plugged(monkeypatch, device)
    with pytest.raises(CameraError, match=r"opens and gives no picture: another program .* USB controller"):
        next(iter(open_source("v4l2:2").frames(threading.Event())))
    assert device.released


@pytest.mark.parametrize("url", ["/dev/null", "v4l2:63", "http://127.0.0.1:1/x", "push:", ""])
def test_what_has_no_serial_number_has_none(url: str) -> None:
    assert serial_of(url) == ""
