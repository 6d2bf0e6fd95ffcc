"""Outputs of a calibration besides its file: residual map, row of figures, profile of a new sensor."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from service.contract import ContractError, FrameSpec, Sensor
from service.contract.refusals import describe
from service.contract.toml import toml_text
from service.perception.lens import transformed
from service.perception.markers.tracker import MarkerTracker
from service.perception.rectification import CameraCalibration, Rectifier
from service.tools.calibrate import Fit, remarks
from service.tools.grid_fit import GridFit

_MAGNIFIED = 20.0  # arrows of the residual map
_GOOD, _FAR, _ABSENT = (120, 220, 60), (40, 120, 255), (80, 80, 255)  # BGR
_PITCH_PX = (12.0, 33.0)  # of a new profile's own rectified frame
_LEAST_PX = 8.0  # of any profile
_AROUND = (1.0, 0.75, 0.5)  # pitches from the outer markers to the edge of a new profile's own frame
_SPARE = 0.25  # pitches by which a frame may reach beyond the picture


def figures(fit: Fit, sensor: Sensor, refused: str | None) -> dict[str, Any]:
    """The row that `calibrate --picture --json` writes: ``residual_px`` is RMS, in the rectified frame.

    ``in_view`` is [rows, columns] before those beyond the number of ``sensor`` were left out.
    """
    rows, columns = fit.grid.shape
    return {
        "residual_px": fit.residual_px,
        "rows": rows,
        "columns": columns,
        "found_share": fit.found_share,
        "in_view": list(fit.grid.in_view),
        "pitch_px": fit.pitch_px,
        "lens_k": None if fit.camera.lens is None else [fit.camera.lens.k1, fit.camera.lens.k2],
        "warp_px": None if fit.camera.warp is None else float(np.abs(fit.camera.warp.coefficients).max()),
        "refused": refused,
        "remarks": remarks(fit, sensor),
    }


def nothing(refused: str) -> dict[str, Any]:
    """The row of a picture in which nothing could be measured."""
    none = {"residual_px": None, "rows": 0, "columns": 0, "found_share": 0.0, "in_view": [0, 0]}
    return {**none, "refused": refused, "remarks": []}


def residual_map(image: NDArray[np.uint8], fit: Fit) -> NDArray[np.uint8]:
    """The rectified frame, twice its size: each marker's deviation, magnified; a cross where one was not found."""
    picture = cv2.resize(Rectifier(fit.camera).apply(image), None, fx=2, fy=2)
    grid = fit.grid
    pitch_px, first_px = fit.pitch_px, fit.first_px
    for row, column in np.argwhere(~grid.present):
        place = 2 * (first_px + pitch_px * np.array([column, row]))
        cv2.drawMarker(picture, _pixel(place), _ABSENT, cv2.MARKER_TILTED_CROSS, 9, 1, cv2.LINE_AA)
    off_px = grid.off * pitch_px
    far = 2 * fit.residual_px
    for cell, off in zip(grid.cells, off_px, strict=True):
        begin = 2 * (first_px + pitch_px * cell)
        colour = _FAR if np.hypot(*off) > far else _GOOD
        cv2.arrowedLine(picture, _pixel(begin), _pixel(begin + _MAGNIFIED * off), colour, 1, cv2.LINE_AA, 0, 0.25)
    text = f"{fit.residual_px:.2f} px RMS, arrows x {_MAGNIFIED / 2:.0f}"
    cv2.putText(picture, text, (6, picture.shape[0] - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.5, _GOOD, 1, cv2.LINE_AA)
    return np.asarray(picture, np.uint8)


def _pixel(place: NDArray[np.float64]) -> tuple[int, int]:
    return round(float(place[0])), round(float(place[1]))


def profile_of(
    image: NDArray[np.uint8], grid: GridFit, name: str, pitch_mm: float, fps: int, like: Sensor | None = None
) -> Sensor:
    """The profile of a new sensor, with the rectified frame of ``like`` where this gel and its picture fill it.

    ``pitch_mm``, the distance of neighbouring markers on the gel, and ``fps`` cannot be measured in a picture. Raises
    ContractError if no profile can describe such a grid.
    """
    rows, columns = grid.shape
    pitch = float(round(float(np.clip(grid.pitch_px, *_PITCH_PX))))
    size = _own_size(image, grid, pitch)
    if like is not None and _fills(image, grid, like, pitch_mm):
        pitch, size = pitch_mm / like.mm_per_px, (like.width_px, like.height_px)
    first, _ = _view(grid, pitch, size)
    straight, _ = cv2.findHomography(first + pitch * grid.cells, grid.raw_px)  # corners cannot state a bending lens
    corners = transformed(np.asarray(straight, np.float64), _corners(size))
    table = {
        "name": name,
        "marker_rows": rows,
        "marker_columns": columns,
        "marker_pitch_px": round(pitch, 4),
        "marker_diameter_px": round(grid.diameter_px * pitch / grid.pitch_px, 1),
        "first_marker_px": (round(float(first[0]), 2), round(float(first[1]), 2)),
        "raw_width_px": image.shape[1],
        "raw_height_px": image.shape[0],
        "width_px": size[0],
        "height_px": size[1],
        "mm_per_px": round(pitch_mm / pitch, 5),
        "fps": fps,
        "gel_width_mm": round((columns + 1) * pitch_mm, 3),
        "gel_height_mm": round((rows + 1) * pitch_mm, 3),
        "gel_margin_mm": (round(pitch_mm, 3), round(pitch_mm, 3)),
        "corners_raw_px": tuple((round(float(u), 1), round(float(v), 1)) for u, v in corners),
    }
    try:
        return Sensor.model_validate(table)
    except ValidationError as error:
        raise ContractError(f"no profile describes {columns} x {rows} markers: {describe(error, Sensor)}") from error


def _view(grid: GridFit, pitch_px: float, size: tuple[int, int]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Of a rectified frame with the grid in its middle: the first marker [2], and its corners in the raw one [4, 2]."""
    rows, columns = grid.shape
    first = (np.array(size, np.float64) - 1 - pitch_px * np.array([columns - 1, rows - 1])) / 2
    return first, grid.projection.raw((_corners(size) - first) / pitch_px)


def _corners(size: tuple[int, int]) -> NDArray[np.float64]:
    """Corner pixels [4, 2] of a frame (width, height), clockwise from the upper left."""
    return np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) * (np.array(size, np.float64) - 1)


def _own_size(image: NDArray[np.uint8], grid: GridFit, pitch_px: float) -> tuple[int, int]:
    """A frame with a pitch around the grid, or less where the picture ends before."""
    for around in _AROUND:
        width, height = (round(pitch_px * (count - 1 + 2 * around)) + 1 for count in grid.shape[::-1])
        if _shown(image, grid, _view(grid, pitch_px, (width, height))[1]):
            break
    return width, height


def _fills(image: NDArray[np.uint8], grid: GridFit, like: Sensor, pitch_mm: float) -> bool:
    """Whether the grid has room in the frame of ``like``, and the picture shows that frame to its edges.

    Nor may more markers be tracked in it than the grid has.
    """
    pitch_px, size = pitch_mm / like.mm_per_px, (like.width_px, like.height_px)
    if not pitch_px >= _LEAST_PX:
        return False
    first, corners = _view(grid, pitch_px, size)
    if not (_shown(image, grid, corners) and first.min() >= pitch_px / 2):
        return False
    scaled = grid.projection.scaled(pitch_px, first)
    raw = FrameSpec(height_px=image.shape[0], width_px=image.shape[1], rectified=False)
    camera = CameraCalibration(scaled.homography, raw, like.rectified, scaled.lens, scaled.warp)
    tracked = MarkerTracker().update(Rectifier(camera).apply(image), 0).valid.shape
    return bool((np.array(tracked) <= grid.shape).all())  # not where the gel's own edge passes for more of them


def _shown(image: NDArray[np.uint8], grid: GridFit, corners: NDArray[np.float64]) -> bool:
    """Whether a picture shows a frame with these corners to its edges.

    Beyond them it would be black, and the tracker would take that for markers.
    """
    spare = _SPARE * grid.pitch_px
    return bool((corners >= -spare).all() and (corners <= np.array(image.shape[1::-1]) - 1 + spare).all())


def save_profile(sensor: Sensor, path: Path) -> None:
    """Write a profile that :meth:`Sensor.load` reads back."""
    head = (
        "# Found by `calibrate --new-profile`: counts, sizes and view are measured in one picture of the resting gel.\n"
        "# mm_per_px and the gel's size follow from the markers' distance, which no picture shows: measure it.\n"
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(head + toml_text(sensor.model_dump(exclude={"name"})), encoding="utf-8")
