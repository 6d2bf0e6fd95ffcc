"""The rectification of both cameras, from a few frames of gels that touch nothing.

The marker grid is regular on the gel, so a homography that makes its image regular rectifies the whole frame.
"""

import threading
import time
from itertools import islice
from math import ceil
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from service.cameras.capture import CameraError
from service.cameras.sources import open_source
from service.contract import Finger, FrameSpec, Sensor
from service.perception.markers.lattice import Lattice, find_lattice, rectifying_homography, resting_px
from service.perception.rectification import CalibrationError, CameraCalibration

MIN_SIDE = 0.71  # of the rows and of the columns
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


def fit_camera(image: NDArray[np.uint8], finger: Finger, sensor: Sensor) -> Fit:
    """The calibration of one camera from a still raw frame; raises CalibrationError if its grid is not visible."""
    lattice = find_lattice(image)
    if lattice is None:
        raise CalibrationError(f"{finger}: no marker grid in the frame; is it the right camera, lit and in focus?")
    rows, cols = lattice.detected.shape
    least_rows, least_cols = (ceil(MIN_SIDE * count) for count in (sensor.marker_rows, sensor.marker_columns))
    if rows < least_rows or cols < least_cols or lattice.detected.mean() < MIN_DETECTED:
        raise CalibrationError(
            f"{finger}: {cols} x {rows} markers visible, {lattice.detected.mean():.0%} of them detected; expected at"
            f" least {least_cols} x {least_rows} and {MIN_DETECTED:.0%}: clean the gel, touch nothing"
        )
    rest_px = resting_px(lattice, sensor)
    matrix = rectifying_homography(lattice, rest_px)
    if matrix is None:
        raise CalibrationError(f"{finger}: the markers do not determine a homography")
    residual_px = _residual_px(lattice, matrix, rest_px)
    if not residual_px <= MAX_RESIDUAL_PX:
        raise CalibrationError(
            f"{finger}: markers lie {residual_px:.2f} px RMS off a regular grid, allowed {MAX_RESIDUAL_PX:g};"
            " something touches the gel, or the lens distorts"
        )
    raw = FrameSpec(height_px=image.shape[0], width_px=image.shape[1], rectified=False)
    return Fit(CameraCalibration(matrix, raw, sensor.rectified), lattice, residual_px)


def _residual_px(lattice: Lattice, matrix: NDArray[np.float64], rest_px: NDArray[np.float64]) -> float:
    mapped = cv2.perspectiveTransform(lattice.xy_px.astype(np.float64), matrix)
    return float(np.sqrt(np.square(mapped - rest_px)[lattice.detected].sum(-1).mean()))
