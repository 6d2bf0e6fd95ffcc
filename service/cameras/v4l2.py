"""A local video device, by the kernel's number or by a name that survives a reboot."""

import os
import re
import threading
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from service.cameras.capture import CameraError, Capture, capture_ns, now_ns
from service.cameras.silence import check_silence

BUFFERS_N = 2  # the driver fills one while the other is read; with a single one it may leave out every second picture


def device_of(url: str) -> str | None:
    """The path of the video device that a URL names, also where it is absent now; None if it names something else.

    A device below /dev/v4l, or another link to one, is followed each time it is opened: its number may change.
    """
    if number := re.fullmatch(r"v4l2:(\d+)", url):
        return f"/dev/video{number[1]}"
    path = url.removeprefix("file:")
    named = re.match(r"/dev/(video\d+$|v4l/.)", path) or re.fullmatch(r"/dev/video\d+", os.path.realpath(path))
    return path if named or (path and Path(path).is_char_device()) else None


def serial_of(url: str) -> str:
    """Serial number of a USB camera if the system reports it, else ""; some models have one for all cameras."""
    device = device_of(url)
    try:
        number = Path(device or "").stat().st_rdev
        text = Path(f"/sys/dev/char/{os.major(number)}:{os.minor(number)}/device/../serial").read_text("ascii")
    except (OSError, UnicodeDecodeError):
        return ""
    return text.strip()


class V4l2Source:
    """A video device, read through OpenCV; stamped with the driver's buffer time.

    The driver stamps the beginning or end of a frame's arrival, on the monotonic clock if it states one
    (V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC, as UVC does). A stamp of another clock is replaced by the time of reading;
    after a silence, during which the driver may have kept pictures, such a device is lost, and opened again.
    """

    def __init__(self, device: str, frame_rate_hz: float) -> None:
        self.name = re.sub(r"^/dev/video(\d+)$", r"v4l2:\1", device)
        self._device, self._frame_rate_hz = device, frame_rate_hz
        # a missing camera is retried four times per second, and OpenCV would warn twice each time
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)

    def frames(self, stop: threading.Event) -> Iterator[Capture]:
        """Open the device and yield what it gives; raises CameraError if it gives nothing."""
        capture = cv2.VideoCapture(self._device, cv2.CAP_V4L2)
        try:
            if not capture.isOpened():
                raise CameraError(f"cannot open {self._device}: {self._obstacle()}")
            capture.set(cv2.CAP_PROP_FPS, self._frame_rate_hz)
            capture.set(cv2.CAP_PROP_BUFFERSIZE, BUFFERS_N)
            same_clock = False
            last_ns: int | None = None
            while not stop.is_set():
                grabbed, pixels = capture.read()
                if not grabbed and last_ns is None:
                    raise CameraError(
                        f"{self._device} opens and gives no picture: another program may read it, or its USB controller"
                        " has no room for another camera"
                    )
                if not grabbed:
                    return
                read_ns = now_ns()
                driver_ns = round(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
                stamp_ns = capture_ns(driver_ns, read_ns, same_clock=same_clock)
                same_clock = same_clock or stamp_ns != read_ns
                if not same_clock:
                    check_silence(last_ns, read_ns)
                last_ns = read_ns
                yield Capture(stamp_ns, np.asarray(pixels, np.uint8))
        finally:
            capture.release()

    def _obstacle(self) -> str:
        device = Path(self._device)
        if not device.exists():
            return "it is not there; is it plugged in?"
        if not os.access(device, os.R_OK | os.W_OK):
            return f"this user may not; it belongs to group {device.stat().st_gid}"
        return "is it a camera, and free?"
