"""`python -m service calibrate`: fit the rectification of both cameras and write it to a file."""

import argparse
from collections.abc import Sequence
from pathlib import Path

import cv2

from service.contract import FINGERS, ContractError, Finger, Sensor
from service.contract.sensor import DEFAULT_SENSOR
from service.perception.rectification import Calibration, CalibrationError, Rectifier
from service.tools.calibrate import Fit, fit_camera, still_image


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
        rows, cols = fit.lattice.detected.shape
        print(
            f"{finger:<6} {cols} x {rows} markers, {fit.lattice.detected.mean():.1%} of them visible,"
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
    description = "fit the rectification of both cameras from a few frames of gels that touch nothing"
    parser = argparse.ArgumentParser(prog="tactile-insertion calibrate", description=description)
    for finger in FINGERS:
        help_text = f"camera of the {finger} finger, as for run: v4l2:N, http://HOST:PORT/PATH or file:PATH"
        parser.add_argument(f"--camera-{finger}", required=True, metavar="URL", help=help_text)
    parser.add_argument("--sensor", default=DEFAULT_SENSOR, help="its name or its TOML profile (%(default)s)")
    parser.add_argument("--out", type=Path, default=Path("calibration.toml"), help="file to write (calibration.toml)")
    parser.add_argument("--frames", type=int, default=15, help="frames a camera; their median is used (15)")
    parser.add_argument("--pictures", type=Path, help="folder for the rectified pictures, to look at")
    return parser.parse_args(arguments)
