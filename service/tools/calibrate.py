"""`python -m service calibrate`: the rectification of both cameras, from a few frames of gels that touch nothing.

The marker grid is regular on the gel, so a homography that makes its image regular rectifies the whole frame.
"""

import argparse
import threading
import time
from collections.abc import Sequence
from itertools import islice
from math import ceil
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from service.cameras.capture import CameraError
from service.cameras.sources import open_source
from service.contract import FINGERS, ContractError, Finger, FrameSpec, Sensor
from service.contract.sensor import DEFAULT_SENSOR
from service.perception.markers.lattice import Lattice, find_lattice, rectifying_homography, resting_px
from service.perception.rectification import Calibration, CalibrationError, CameraCalibration, Rectifier

MIN_SIDE = 0.71  # of the rows and of the columns
MIN_FOUND = 0.9
MAX_RESIDUAL_PX = 1.0
WAIT_S = 10.0


class Fit(NamedTuple):
    """One camera's calibration and how well the markers obey it: RMS distance from the regular grid, rectified px."""

    camera: CameraCalibration
    lattice: Lattice
    residual_px: float


def main(arguments: Sequence[str]) -> int:
    """Fit both fingers and write the file; raises CalibrationError or CameraError naming the finger."""
    options = _parse(arguments)
    try:
        sensor = Sensor.load(options.sensor)
    except ContractError as error:
        raise CalibrationError(f"--sensor: {error}") from error
    fits: dict[Finger, Fit] = {}
    for finger in FINGERS:
        image = still_image(getattr(options, f"camera_{finger}"), options.frames)
        fits[finger] = fit = fit_camera(image, finger, sensor)
        rows, cols = fit.lattice.found.shape
        print(
            f"{finger:<6} {cols} x {rows} markers, {fit.lattice.found.mean():.1%} of them seen,"
            f" {fit.residual_px:.2f} px RMS off the regular grid"
        )
        if options.pictures is not None:
            options.pictures.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(options.pictures / f"{finger}.png"), Rectifier(fit.camera).apply(image))
    options.out.parent.mkdir(parents=True, exist_ok=True)
    Calibration(fits["left"].camera, fits["right"].camera).save(options.out)
    print(f"wrote {options.out}")
    return 0


def _parse(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="tactile-insertion calibrate", description=(__doc__ or "").split(": ", 1)[1])
    for finger in FINGERS:
        help_text = f"camera of the {finger} finger, as for run: v4l2:N, http://HOST:PORT/PATH or file:PATH"
        parser.add_argument(f"--camera-{finger}", required=True, metavar="URL", help=help_text)
    parser.add_argument("--sensor", default=DEFAULT_SENSOR, help="its name or its TOML profile (%(default)s)")
    parser.add_argument("--out", type=Path, default=Path("calibration.toml"), help="file to write (calibration.toml)")
    parser.add_argument("--frames", type=int, default=15, help="frames a camera; their median is used (15)")
    parser.add_argument("--pictures", type=Path, help="folder for the rectified pictures, to look at")
    return parser.parse_args(arguments)


def still_image(url: str, frames: int) -> NDArray[np.uint8]:
    """Median uint8 [h, w, 3] of a camera's next frames; raises CameraError if they do not come within ten seconds."""
    stop = threading.Event()
    timer = threading.Timer(WAIT_S, stop.set)
    timer.start()
    began = time.monotonic()
    try:
        seen = [capture.image() for capture in islice(open_source(url).frames(stop), max(frames, 1))]
    except OSError as error:
        raise CameraError(f"camera {url}: {error}") from error
    finally:
        timer.cancel()
    if not seen:
        raise CameraError(f"camera {url} gave no frame within {time.monotonic() - began:.0f} s")
    if len({pixels.shape for pixels in seen}) > 1:
        raise CameraError(f"camera {url} changed its frame size while it was watched")
    return np.asarray(np.median(np.stack(seen), axis=0), np.uint8)


def fit_camera(image: NDArray[np.uint8], finger: Finger, sensor: Sensor) -> Fit:
    """The calibration of one camera from a still raw frame; raises CalibrationError if the grid is not fully seen."""
    lattice = find_lattice(image)
    if lattice is None:
        raise CalibrationError(f"{finger}: no marker grid in the frame; is it the right camera, lit and in focus?")
    rows, cols = lattice.found.shape
    least_rows, least_cols = (ceil(MIN_SIDE * count) for count in (sensor.marker_rows, sensor.marker_columns))
    if rows < least_rows or cols < least_cols or lattice.found.mean() < MIN_FOUND:
        raise CalibrationError(
            f"{finger}: saw {cols} x {rows} markers, {lattice.found.mean():.0%} of them;"
            f" expected at least {least_cols} x {least_rows} and {MIN_FOUND:.0%}: clean the gel, touch nothing"
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
    return float(np.sqrt(np.square(mapped - rest_px)[lattice.found].sum(-1).mean()))
