"""`python -m service calibrate`: fit the rectification of both cameras, or measure one picture of a resting gel."""

import argparse
import contextlib
import json
import shutil
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TextIO

import cv2
import numpy as np
from numpy.typing import NDArray

from service.cameras.recorded import picture_in
from service.cameras.v4l2 import serial_of
from service.contract import FINGERS, ContractError, Finger, Sensor
from service.contract.sensor import DEFAULT_SENSOR, EDGES
from service.contract.text import Parser
from service.perception.rectification import Calibration, CalibrationError, Rectifier
from service.tools.calibrate import (
    Fit,
    check_two_cameras,
    find_grid,
    fit_camera,
    of_sensor,
    rectify,
    refusal,
    remarks,
    still_image,
)
from service.tools.calibration_output import figures, nothing, profile_of, residual_map, save_profile

STDOUT = Path("-")


def main(arguments: Sequence[str]) -> int:
    """Fit both fingers, or one picture; raises CalibrationError or CameraError naming the fault."""
    options = _parse(arguments)
    if options.picture is not None:
        out = sys.stdout
        with contextlib.redirect_stdout(sys.stderr if options.json == STDOUT else out):
            return _measure(options, out)
    if options.camera_left is None or options.camera_right is None:
        raise CalibrationError("expected --camera-left and --camera-right, or --picture")
    sensor: Sensor | None = None if options.new_profile else _sensor(options.sensor)
    fits: dict[Finger, Fit] = {}
    for finger in FINGERS:
        url = getattr(options, f"camera_{finger}")
        image = still_image(url, options.frames)
        if sensor is None:
            sensor = _new_profile(options, image, finger)
        fits[finger] = fit = fit_camera(image, finger, sensor, serial_of(url))
        if options.new_profile and finger == FINGERS[0]:
            _save(options, sensor)
        print(_line(finger, fit, sensor))
        _draw(options.pictures, finger, image, fit)
    check_two_cameras((options.camera_left, fits["left"]), (options.camera_right, fits["right"]))
    options.out.parent.mkdir(parents=True, exist_ok=True)
    if earlier := _kept(options.out):
        print(f"the calibration of before is kept as {earlier}: a commissioning that was made with it names its gels")
    Calibration(fits["left"].camera, fits["right"].camera).save(options.out)
    print(f"wrote {options.out}")
    return 0


def _kept(path: Path) -> Path | None:
    """A copy of a file that is about to be replaced, named by the time of its last change; None if there is none."""
    if not path.exists():
        return None
    made = datetime.fromtimestamp(path.stat().st_mtime, UTC)
    earlier = path.with_name(f"{path.stem}.{made:%Y%m%dT%H%M%S%f}{path.suffix}")
    return Path(shutil.copy2(path, earlier))


def _measure(options: argparse.Namespace, out: TextIO) -> int:
    """Measure how well the markers of one picture fit the model; the row is written even if it is refused."""
    path: Path = options.picture
    name = options.sensor if options.new_profile is None else options.new_profile.stem
    try:
        picture = _picture(path)
        sensor = _new_profile(options, picture, path.name) if options.new_profile else _sensor(options.sensor)
        grid = find_grid(picture, path.name, sensor)
        # a grid of another sensor is measured in the picture's own pixels
        own = sensor if of_sensor(grid, sensor) else profile_of(picture, grid, "as_seen", options.pitch_mm, options.fps)
        fit = rectify(picture, grid, own)
    except (ContractError, CalibrationError) as error:
        _write(options.json, {"picture": path.name, "sensor": name, **nothing(str(error))}, out)
        raise
    refused = refusal(fit, sensor)
    _write(options.json, {"picture": path.name, "sensor": sensor.name, **figures(fit, own, refused)}, out)
    print(_line(path.name, fit, own) + ("" if refused is None else f"\nno calibration of {sensor.name}: {refused}"))
    _draw(options.pictures, path.stem, picture, fit)
    if options.new_profile and refused is not None:
        raise CalibrationError(f"{path.name}: {refused}; {options.new_profile} is not written")
    if options.new_profile:
        _save(options, sensor)
    return 0


def _picture(path: Path) -> NDArray[np.uint8]:
    """The picture in a file; CalibrationError if it holds none."""
    try:
        picture = picture_in(path)
    except OSError as error:
        raise CalibrationError(f"--picture {path}: {error.strerror or error}") from error
    if picture is None:
        raise CalibrationError(f"--picture {path}: no picture, a damaged one, or of an unknown format")
    return picture


def _sensor(name: str) -> Sensor:
    try:
        return Sensor.load(name)
    except ContractError as error:
        raise CalibrationError(f"--sensor: {error}") from error


def _new_profile(options: argparse.Namespace, image: np.ndarray, name: str) -> Sensor:
    """A new profile from this picture, in the frame that the released networks read if it has room there."""
    if options.new_profile.suffix != ".toml":
        raise CalibrationError(f"--new-profile {options.new_profile}: expected a file name that ends in .toml")
    grid = find_grid(image, name, None, options.up)
    return profile_of(image, grid, options.new_profile.stem, options.pitch_mm, options.fps, Sensor.load())


def _save(options: argparse.Namespace, sensor: Sensor) -> None:
    """Write the new profile, which its picture has been fitted to."""
    if earlier := _kept(options.new_profile):
        print(f"the profile of before is kept as {earlier}: what was measured in it is not in the new one")
    save_profile(sensor, options.new_profile)
    print(f"wrote {options.new_profile}; markers taken as {options.pitch_mm:g} mm apart, {options.fps} frames a second")


def _line(name: str, fit: Fit, sensor: Sensor) -> str:
    rows, columns = fit.grid.shape
    return (
        f"{name:<6} {columns} x {rows} markers, {fit.found_share:.1%} of them found,"
        f" {fit.residual_px:.2f} px RMS off the regular grid"
        + "".join(f"\n{name}: {odd}" for odd in remarks(fit, sensor))
    )


def _draw(folder: Path | None, name: str, image: np.ndarray, fit: Fit) -> None:
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / f"{name}.png"), Rectifier(fit.camera).apply(image))
        cv2.imwrite(str(folder / f"{name}_residual.png"), residual_map(image, fit))


def _write(path: Path | None, row: dict[str, object], out: TextIO) -> None:
    text = json.dumps(row, indent=1) + "\n"
    if path == STDOUT:
        out.write(text)
    elif path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")


def _parse(arguments: Sequence[str]) -> argparse.Namespace:
    description = "fit the rectification of both cameras from a few frames of gels that touch nothing"
    parser = Parser(prog="tactile-insertion calibrate", description=description)
    for finger in FINGERS:
        help_text = f"camera of the {finger} finger, as for run: v4l2:N, http://HOST:PORT/PATH or file:PATH"
        parser.add_argument(f"--camera-{finger}", metavar="URL", help=help_text)
    parser.add_argument(
        "--picture", type=Path, help="measure this picture of a resting gel instead, write no calibration"
    )
    row_help = "with --picture: file for residual_px, rows, columns and so on; without one they go to stdout alone"
    parser.add_argument("--json", nargs="?", type=Path, const=STDOUT, metavar="FILE", help=row_help)
    parser.add_argument("--sensor", default=DEFAULT_SENSOR, help="name or TOML profile of the sensor (%(default)s)")
    parser.add_argument("--new-profile", type=Path, metavar="TOML", help="count the markers, write this profile")
    parser.add_argument("--pitch-mm", type=float, default=1.5, help="with --new-profile: distance of its markers (1.5)")
    up_help = "with --new-profile: edge of the picture that shows the end of the gel away from the table (top)"
    parser.add_argument("--up", choices=EDGES, help=up_help)
    parser.add_argument("--fps", type=int, help="with --new-profile: frames per second (30)")
    parser.add_argument("--out", type=Path, default=Path("calibration.toml"), help="file to write (calibration.toml)")
    parser.add_argument("--frames", type=int, default=15, help="frames per camera; their median is used (15)")
    parser.add_argument("--pictures", type=Path, help="folder for rectified pictures and residual maps, for inspection")
    options = parser.parse_args(arguments)
    if options.new_profile is None and (options.up or options.fps is not None):
        raise CalibrationError("--up and --fps describe a new profile: expected with --new-profile TOML")
    if options.picture is None and options.json:
        raise CalibrationError("--json takes the figures of one picture: expected with --picture FILE")
    options.up, options.fps = options.up or "top", 30 if options.fps is None else options.fps
    return options
