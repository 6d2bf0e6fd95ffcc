"""The rectification of a camera, from a few frames of an untouched gel.

The marker grid is regular on the gel, so the mapping that makes its image regular rectifies the whole frame.
"""

import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from http.client import HTTPException
from itertools import islice
from math import ceil
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from service.cameras.capture import CameraError
from service.cameras.sources import open_source
from service.contract import Finger, FrameSpec, Sensor
from service.contract.frames import MAX_SIDE_PX
from service.contract.sensor import Edge
from service.contract.text import without_secrets
from service.perception.lens import transformed
from service.perception.light import light_of
from service.perception.markers.fingerprint import fingerprint_of
from service.perception.markers.tracker import MarkerTracker
from service.perception.rectification import CalibrationError, CameraCalibration, Measured, Rectifier
from service.tools.grid_fit import GridFit, fit_grid, view_of

MIN_SIDE = 0.71  # share of the rows and of the columns
MIN_PRESENT = 0.7
MAX_DISPLACED = 0.1  # share of the grid's markers: visible, but not at a resting gel's positions
MAX_SLANT_DEG = 20.0  # real sensors are below 4; rows that are offset by half a step are 27 or 30 off
MAX_OFF = 0.03  # pitches, RMS; resting gels of three real sensors are below 0.02
_OTHER_PITCH = 0.15  # markers this much closer or further apart than the profile says are another gel's
_ONE_PLACE = 0.01  # pitches; markers of two real fingers lie 0.13 or more apart in their pictures, of one 0.002
_BENT = 0.1  # pitches, by which rows may be bent beyond the lens without a remark
_PITCHES_OFF = {1: "half a pitch", 2: "a pitch"}  # by the number of rows that are missing at one edge or other
WAIT_S = 10.0
_DARK, _GLARE = 12, 243  # mean grey levels of a frame without light, and of one with too much


class Fit(NamedTuple):
    """One camera's calibration, its grid, and the deviation of its markers, RMS in rectified px.

    In the rectified frame the grid's first marker rests at ``first_px`` [2], its neighbours ``pitch_px`` from it.
    """

    camera: CameraCalibration
    grid: GridFit
    residual_px: float
    first_px: NDArray[np.float64]
    pitch_px: float

    @property
    def found_share(self) -> float:
        """Share of the grid's nodes with a marker in the correct place."""
        return float(self.grid.present.mean())


def still_image(url: str, frames: int) -> NDArray[np.uint8]:
    """Median uint8 [h, w, 3] of a camera's next frames; raises CameraError if they do not come within ten seconds."""
    source, stop, shown = open_source(url), threading.Event(), without_secrets(url)
    timer = threading.Timer(WAIT_S, stop.set)
    timer.start()
    began = time.monotonic()
    try:
        images = [capture.image() for capture in islice(source.frames(stop), max(frames, 1))]
    except (OSError, HTTPException, ValueError) as error:
        raise CameraError(f"camera {shown}: {str(error) or type(error).__name__}") from error
    finally:
        timer.cancel()
    if not images:
        raise CameraError(f"camera {shown} gave no frame within {time.monotonic() - began:.0f} s")
    if len({pixels.shape for pixels in images}) > 1:
        raise CameraError(f"camera {shown} changed its frame size while it was watched")
    return np.asarray(np.median(np.stack(images), axis=0), np.uint8)


def find_grid(image: NDArray[np.uint8], name: str, sensor: Sensor | None, up: Edge = "top") -> GridFit:
    """The marker grid of a raw frame; raises CalibrationError naming ``name`` and the likely cause if there is none.

    Without a sensor that states it, the first row is that at the edge ``up``.
    """
    if max(image.shape[:2]) > MAX_SIDE_PX:
        size = f"{image.shape[1]} x {image.shape[0]}"
        raise CalibrationError(f"{name}: the frame is {size} px, expected {MAX_SIDE_PX} px a side or less")
    grid = fit_grid(image, sensor, up if sensor is None else sensor.up)
    if grid is None:
        cause = _cause(image, sensor)
        raise CalibrationError(f"{name}: no marker grid in the frame, and this software needs one; {cause}")
    if grid.slant_deg > MAX_SLANT_DEG:
        raise CalibrationError(
            f"{name}: columns and rows of markers are {grid.slant_deg:.0f} deg from a right angle, allowed"
            f" {MAX_SLANT_DEG:g}: rows offset by half a step (a hexagonal grid) are not supported, nor is so oblique a"
            " view"
        )
    return grid


def _cause(image: NDArray[np.uint8], sensor: Sensor | None) -> str:
    """The likely reason why a raw frame shows no grid."""
    if fit_grid(np.asarray(255 - image, np.uint8), sensor) is not None:  # on a dark gel, most of the frame is black
        return "its markers are lighter than the gel around them, and only darker ones are tracked"
    level = float(image.mean())
    if level <= _DARK:
        return "the frame is black: is the light on?"
    if level >= _GLARE:
        return "the frame is white: is the light too bright?"
    return "is this a sensor with markers in straight rows and columns, and is it in focus?"


def rectify(image: NDArray[np.uint8], grid: GridFit, sensor: Sensor, serial: str = "") -> Fit:
    """The calibration that centres ``grid`` on the sensor's; raises CalibrationError if that is impossible."""
    rows, columns = grid.shape
    spare = np.array([sensor.marker_columns - columns, sensor.marker_rows - rows]) / 2
    first = np.asarray(sensor.first_marker_px) + spare * sensor.marker_pitch_px
    projection = grid.projection.scaled(sensor.marker_pitch_px, first)
    residual_px = float(np.sqrt(np.square(grid.off).sum(-1).mean())) * sensor.marker_pitch_px
    raw = FrameSpec(height_px=image.shape[0], width_px=image.shape[1], rectified=False)
    camera = CameraCalibration(projection.homography, raw, sensor.rectified, projection.lens, projection.warp)
    rectified = Rectifier(camera).apply(image)
    measured = Measured(
        datetime.now(UTC).isoformat(timespec="seconds"),
        serial,
        round(residual_px, 4),
        round(float(grid.present.mean()), 4),
        fingerprint_of(MarkerTracker().update(rectified, 0)),
        light_of(rectified),
    )
    camera = replace(camera, measured=measured, mm_per_px=sensor.mm_per_px)
    return Fit(camera, grid, residual_px, first, sensor.marker_pitch_px)


def of_sensor(grid: GridFit, sensor: Sensor) -> bool:
    """Whether a grid can be the sensor's: not larger, and complete apart from dark edges."""
    pairs = zip(grid.shape, (sensor.marker_rows, sensor.marker_columns), strict=True)
    return all(ceil(MIN_SIDE * count) <= fitted <= count for fitted, count in pairs)


def refusal(fit: Fit, sensor: Sensor) -> str | None:
    """Why a fit is not a calibration of this sensor, None if it is one."""
    rows, columns = fit.grid.shape
    if not of_sensor(fit.grid, sensor):
        return (
            f"{columns} x {rows} markers found, the profile {sensor.name} has {sensor.marker_columns} x"
            f" {sensor.marker_rows}: is it another sensor or a turned camera (--new-profile), or does something"
            " touch the gel?"
        )
    if fit.found_share < MIN_PRESENT:
        return (
            f"{fit.found_share:.0%} of {columns} x {rows} markers found on a regular grid, expected {MIN_PRESENT:.0%}:"
            " clean the gel, and look whether something touches the gel"
        )
    if fit.grid.displaced_n > MAX_DISPLACED * rows * columns:
        return (
            f"{fit.grid.displaced_n} of {columns} x {rows} markers lie off the regular grid; something touches the gel"
        )
    if not fit.residual_px <= MAX_OFF * fit.pitch_px:
        return (
            f"markers lie {fit.residual_px:.2f} px RMS off a regular grid, allowed {MAX_OFF * fit.pitch_px:.2f};"
            " something touches the gel"
        )
    nominal_px = _nominal_pitch_px(sensor) * fit.camera.raw.width_px / sensor.raw_width_px
    if abs(fit.grid.pitch_px / nominal_px - 1) > _OTHER_PITCH:
        return (
            f"markers {fit.grid.pitch_px:.1f} px apart, the profile {sensor.name} has them {nominal_px:.1f} px apart in"
            " a frame of this width: is it another gel or lens (--new-profile, with --pitch-mm)?"
        )
    followed = fit.camera.measured is not None and bool(fit.camera.measured.fingerprint)
    return (
        None if followed else "the service finds no grid in the rectified picture: are the markers too faint in grey?"
    )


def _nominal_pitch_px(sensor: Sensor) -> float:
    """Mean distance of neighbouring markers in the profile's raw frame."""
    rest = sensor.marker_rest_px()
    raw = transformed(view_of(sensor), rest.reshape(-1, 2).astype(np.float64)).reshape(rest.shape)
    steps = [np.linalg.norm(np.diff(raw, axis=axis), axis=-1).mean() for axis in (0, 1)]
    return float(np.mean(steps))


def remarks(fit: Fit, sensor: Sensor) -> list[str]:
    """What a person should look at in a fit that is a calibration of this sensor."""
    return [*_other_shape(fit.grid, sensor), *_bent(fit)]


def _other_shape(grid: GridFit, sensor: Sensor) -> Iterator[str]:
    """Where the rows or columns in view are not the profile's, and so the frame's place is uncertain."""
    expected_n = (sensor.marker_rows, sensor.marker_columns)
    for lines, in_view_n, kept_n, whole_n in zip(
        ("rows", "columns"), grid.in_view, grid.shape, expected_n, strict=True
    ):
        if (over_n := in_view_n - kept_n) > 0:
            yield (
                f"{in_view_n} {lines} in view, {kept_n} kept: which of them are the profile's cannot be told, so the"
                f" frame may be up to {over_n} {'pitch' if over_n == 1 else 'pitches'} off"
            )
        elif kept_n < whole_n:
            away = _PITCHES_OFF.get(whole_n - kept_n, f"{(whole_n - kept_n) / 2:g} pitches")
            yield (
                f"{kept_n} of {whole_n} {lines} in view: at which edge others are missing cannot be told, so the frame"
                f" may be {away} off"
            )


def _bent(fit: Fit) -> Iterator[str]:
    """How far rows are bent beyond the lens."""
    warp = fit.camera.warp
    if warp is None:
        return
    u, v = np.meshgrid(*np.linspace(warp.low, warp.high, 9).T)
    places = np.stack([u.ravel(), v.ravel()], 1)
    bent = float(np.linalg.norm(warp.apply(places) - places, axis=1).max()) / fit.pitch_px
    if bent > _BENT:
        yield (
            f"rows are bent by up to {bent:.2f} of the markers' distance, beyond the lens: a gel glued unevenly or"
            " seen in a mirror is so; if this one is flat, something presses it"
        )


def fit_camera(image: NDArray[np.uint8], finger: Finger, sensor: Sensor, serial: str = "") -> Fit:
    """The calibration of one camera from a still raw frame; raises CalibrationError if it shows no resting gel."""
    fit = rectify(image, find_grid(image, finger, sensor), sensor, serial)
    refused = refusal(fit, sensor)
    if refused is not None:
        raise CalibrationError(f"{finger}: {refused}")
    return fit


def check_two_cameras(left: tuple[str, Fit], right: tuple[str, Fit]) -> None:
    """Raise CalibrationError if both fingers, (URL, fit) each, were calibrated with one camera.

    Fingerprints do not decide: of two small gels they may be alike, by the bend of their lenses. Nor do serial numbers:
    some models have one for all cameras.
    """
    (left_url, left_fit), (right_url, right_fit) = left, right
    if left_url == right_url:
        raise CalibrationError(
            f"left and right are the same camera, {without_secrets(left_url)}; expected one for each finger"
        )
    if _apart(left_fit, right_fit) < _ONE_PLACE:
        raise CalibrationError("left and right show the same gel, each marker in one place: two URLs of one camera?")


def _apart(one: Fit, other: Fit) -> float:
    """Median distance in pitches of one picture's markers from the nearest of another, both at one size."""
    size = np.array([one.camera.raw.width_px, one.camera.raw.height_px], np.float64)
    other_size = [other.camera.raw.width_px, other.camera.raw.height_px]
    there_px = (other.grid.raw_px + 0.5) * (size / other_size) - 0.5
    away_px = np.linalg.norm(one.grid.raw_px[:, None] - there_px, axis=-1).min(1)
    return float(np.median(away_px)) / one.grid.pitch_px
