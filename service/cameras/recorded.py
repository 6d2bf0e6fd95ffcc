"""Frames of files: a recording as a camera, the pictures of a clip, a single picture."""

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from service.cameras.capture import CameraError, Capture, decoded, now_ns

IMAGES = {".png", ".jpg", ".jpeg", ".bmp"}
_UNCOUNTED = {".mkv", ".webm"}  # their headers state no number of frames, and OpenCV makes one up from the duration


class RecordingSource:
    """A video file or a folder of images, played in a loop at its own rate."""

    def __init__(self, path: Path) -> None:
        self.name, self._path = str(path), path
        if not path.exists():
            raise CameraError(f"recording {path} does not exist")

    def frames(self, stop: threading.Event) -> Iterator[Capture]:
        while not stop.is_set():
            played = 0
            due = time.monotonic()
            for pixels, rate_hz in clip_images(self._path):
                due += 1.0 / rate_hz
                if stop.wait(max(0.0, due - time.monotonic())):
                    return
                played += 1
                yield Capture(now_ns(), pixels)
            if not played:
                raise CameraError(f"{self._path} holds no image that can be read")


def clip_images(path: Path) -> Iterator[tuple[NDArray[np.uint8], float]]:
    """BGR image and frame rate (Hz) of each frame of a video, or of a folder of images by name (30 Hz).

    Hidden files are left out. Raises CameraError if the video's name is no UTF-8.
    """
    if path.is_dir():
        for file in sorted(child for child in path.iterdir() if child.suffix.lower() in IMAGES and child.is_file()):
            image = None if file.name.startswith(".") else picture_in(file)
            if image is not None:
                yield image, 30.0
        return
    capture = _opened(path)
    try:
        rate_hz = capture.get(cv2.CAP_PROP_FPS) or 30.0
        while (read := capture.read())[0]:
            yield np.asarray(read[1], np.uint8), rate_hz
    finally:
        capture.release()


def stated_frames_n(video: Path) -> int:
    """The number of frames that a video's header states, 0 if it states none."""
    if video.suffix.lower() in _UNCOUNTED:
        return 0
    capture = _opened(video)
    try:
        return max(0, int(capture.get(cv2.CAP_PROP_FRAME_COUNT)))
    finally:
        capture.release()


def _opened(video: Path) -> cv2.VideoCapture:
    """OpenCV takes a relative name for a URL or a pattern, and crashes on one that is no UTF-8."""
    name = str(video.absolute())
    if any("\ud800" <= letter <= "\udfff" for letter in name):
        raise CameraError(f"the name {name!a} is no UTF-8, and OpenCV would crash on it: rename it")
    return cv2.VideoCapture(name)


def picture_in(file: Path) -> NDArray[np.uint8] | None:
    """The BGR picture in a file of any name; None if it holds none. Raises OSError if it cannot be read."""
    return decoded(np.fromfile(file, np.uint8))
