"""Outputs of a calibration besides its file: residual map, row of figures, profile of a new sensor."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from service.contract import ContractError, Sensor
from service.contract.refusals import describe
from service.perception.rectification import Rectifier
from service.tools.calibrate import Fit
from service.tools.grid_fit import GridFit

_MAGNIFIED = 20.0  # arrows of the residual map
_GOOD, _FAR, _ABSENT = (120, 220, 60), (40, 120, 255), (80, 80, 255)  # BGR
_PITCH_PX = (12.0, 33.0)  # of a new profile's rectified frame


def figures(fit: Fit, refused: str | None) -> dict[str, Any]:
    """The row that `calibrate --picture --json` writes: ``residual_px`` is RMS, in the rectified frame."""
    rows, columns = fit.grid.shape
    return {
        "residual_px": fit.residual_px,
        "rows": rows,
        "columns": columns,
        "found_share": fit.found_share,
        "pitch_px": fit.pitch_px,
        "lens_k": None if fit.camera.lens is None else [fit.camera.lens.k1, fit.camera.lens.k2],
        "warp_px": None if fit.camera.warp is None else float(np.abs(fit.camera.warp.coefficients).max()),
        "refused": refused,
    }


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


def profile_of(image: NDArray[np.uint8], grid: GridFit, name: str, pitch_mm: float, fps: int) -> Sensor:
    """The profile of a new sensor.

    ``pitch_mm``, the distance of neighbouring markers on the gel, and ``fps`` cannot be measured in a picture. Raises
    ContractError if no profile can describe such a grid.
    """
    rows, columns = grid.shape
    pitch = round(float(np.clip(grid.pitch_px, *_PITCH_PX)))
    size = [pitch * (count + 1) + 1 for count in (columns, rows)]
    view = np.array([(0, 0), (size[0] - 1, 0), (size[0] - 1, size[1] - 1), (0, size[1] - 1)], np.float64)
    corners = grid.projection.raw(view / pitch - 1)
    table = {
        "name": name,
        "marker_rows": rows,
        "marker_columns": columns,
        "marker_pitch_px": float(pitch),
        "marker_diameter_px": round(grid.diameter_px * pitch / grid.pitch_px, 1),
        "first_marker_px": (float(pitch), float(pitch)),
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


def save_profile(sensor: Sensor, path: Path) -> None:
    """Write a profile that :meth:`Sensor.load` reads back."""
    head = [
        "# Found by `calibrate --new-profile`: counts, sizes and view are measured in one picture of the resting gel.",
        "# mm_per_px and the gel's size follow from the markers' distance, which no picture shows: measure it.",
    ]
    values = [f"{key} = {json.dumps(value)}" for key, value in sensor.model_dump(exclude={"name"}).items()]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join([*head, *values]) + "\n", encoding="utf-8")
