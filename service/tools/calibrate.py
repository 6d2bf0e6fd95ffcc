"""The rectification of both cameras, from a few frames of gels that touch nothing.

The marker grid is regular on the gel, so a homography that makes its image regular rectifies the whole frame.
"""

import threading
import time
from itertools import islice
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from service.cameras.capture import CameraError
from service.cameras.sources import open_source
from service.contract import Finger, FrameSpec
from service.perception.markers.lattice import Lattice, find_lattice, rectifying_homography
from service.perception.rectification import RECTIFIED, CalibrationError, CameraCalibration

PITCH_PX = 15.0  # of the rectified grid; what the published slip thresholds and the released networks go by
MIN_MARKERS = (15, 15)
MIN_DETECTED = 0.9
MAX_RESIDUAL_PX = 1.0
WAIT_S = 10.0


class Fit(NamedTuple):
    """One camera's calibration and how well the markers obey it: RMS distance from the regular grid, rectified px."""

    camera: CameraCalibration
    lattice: Lattice
    residual_px: float


def still_image(url: str, frames: int) -> NDArray[np.uint8]:
    """Median uint8 [h, w, 3] of a camera's next frames; raises CameraError if they do not come within ten seconds."""
    stop = threading.Event()
    timer = threading.Timer(WAIT_S, stop.set)
    timer.start()
    began = time.monotonic()
    try:
        images = [capture.image() for capture in islice(open_source(url).frames(stop), max(frames, 1))]
    except OSError as error:
        raise CameraError(f"camera {url}: {error}") from error
    finally:
        timer.cancel()
    if not images:
        raise CameraError(f"camera {url} gave no frame within {time.monotonic() - began:.0f} s")
    if len({pixels.shape for pixels in images}) > 1:
        raise CameraError(f"camera {url} changed its frame size while it was watched")
    return np.asarray(np.median(np.stack(images), axis=0), np.uint8)


def fit_camera(image: NDArray[np.uint8], finger: Finger) -> Fit:
    """The calibration of one camera from a still raw frame; raises CalibrationError if its grid is not visible."""
    lattice = find_lattice(image)
    if lattice is None:
        raise CalibrationError(f"{finger}: no marker grid in the frame; is it the right camera, lit and in focus?")
    rows, cols = lattice.detected.shape
    if rows < MIN_MARKERS[0] or cols < MIN_MARKERS[1] or lattice.detected.mean() < MIN_DETECTED:
        raise CalibrationError(
            f"{finger}: {cols} x {rows} markers visible, {lattice.detected.mean():.0%} of them detected; expected at"
            f" least {MIN_MARKERS[1]} x {MIN_MARKERS[0]} and {MIN_DETECTED:.0%}: clean the gel, touch nothing"
        )
    matrix = rectifying_homography(lattice, RECTIFIED.width_px, RECTIFIED.height_px, PITCH_PX)
    if matrix is None:
        raise CalibrationError(f"{finger}: the markers do not determine a homography")
    residual_px = _residual_px(lattice, matrix)
    if not residual_px <= MAX_RESIDUAL_PX:
        raise CalibrationError(
            f"{finger}: markers lie {residual_px:.2f} px RMS off a regular grid, allowed {MAX_RESIDUAL_PX:g};"
            " something touches the gel, or the lens distorts"
        )
    raw = FrameSpec(height_px=image.shape[0], width_px=image.shape[1], rectified=False)
    return Fit(CameraCalibration(matrix, raw, RECTIFIED), lattice, residual_px)


def _residual_px(lattice: Lattice, matrix: NDArray[np.float64]) -> float:
    rows, cols = lattice.detected.shape
    mapped = cv2.perspectiveTransform(lattice.xy_px.astype(np.float64), matrix)
    ideal = np.stack(np.meshgrid(np.arange(cols) - (cols - 1) / 2, np.arange(rows) - (rows - 1) / 2), -1) * PITCH_PX
    ideal += np.array([(RECTIFIED.width_px - 1) / 2, (RECTIFIED.height_px - 1) / 2])
    return float(np.sqrt(np.square(mapped - ideal)[lattice.detected].sum(-1).mean()))
