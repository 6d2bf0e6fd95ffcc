"""The real recordings, where this machine has them."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[3]
GELSLIM_CROP = (0, 28, 384, 278)  # left, top, width, height of the sensor in the screen recording


def real_data(name):
    """Folder of one recording set; skips the test with the reason if it is absent."""
    given = os.environ.get("TACTILE_REAL_DATA")
    folder = (Path(given) if given else ROOT.parent / "shared" / "real_tactile") / name
    if not folder.is_dir():
        pytest.skip(f"no real recordings at {folder}; set TACTILE_REAL_DATA to their folder")
    return folder


def read_video(path, crop=None):
    """All frames of a clip, uint8 BGR."""
    capture = cv2.VideoCapture(str(path))
    frames = []
    while True:
        ok, frame = capture.read()
        if not ok:
            capture.release()
            return frames
        if crop:
            left, top, width, height = crop
            frame = np.ascontiguousarray(frame[top : top + height, left : left + width])
        frames.append(np.asarray(frame, np.uint8))
