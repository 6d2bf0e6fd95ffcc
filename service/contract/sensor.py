"""The sensor: all properties of one type of tactile finger, defined only here, read from a TOML profile.

Finger frame: u to the right, v down; pixel centres lie at integers. Pixels are those of the rectified frame unless a
key says raw. Profiles that are known by name lie in `service/sensors`.
"""

from functools import cache
from pathlib import Path
from typing import Annotated, Literal, Self, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError, model_validator

from service.contract.frames import MAX_SIDE_PX, Contract, ContractError, FrameSpec
from service.contract.refusals import describe, nearest
from service.contract.toml import read_toml

SENSORS = Path(__file__).parents[1] / "sensors"
DEFAULT_SENSOR = "gelslim_2019"
"""The sensor of every dataset, checkpoint and model card older than its sensor field."""

Edge = Literal["top", "right", "bottom", "left"]
EDGES: tuple[Edge, ...] = get_args(Edge)
Side = Annotated[int, Field(ge=64, le=MAX_SIDE_PX)]
Point = Annotated[tuple[float, float], Field(strict=False)]
Corners = Annotated[tuple[Point, Point, Point, Point], Field(strict=False)]


class MarkerSpec(Contract):
    """A grid of markers in the rectified frame.

    ``first_px`` (u, v) is the rest position of the marker in the first row and column, the others are ``pitch_px``
    apart.
    """

    rows: int = Field(ge=2, le=256)
    columns: int = Field(ge=2, le=256)
    pitch_px: float = Field(gt=0)
    first_px: tuple[float, float]


class Sensor(Contract):
    """The profile of a tactile sensor.

    ``first_marker_px`` (u, v): rest position of the first marker of the first row. ``gel_width_mm`` (u) and
    ``gel_height_mm`` (v): the pad that is pressed. ``gel_margin_mm`` (u, v): from its left and upper edge to the first
    marker. ``corners_raw_px``, the view of the lens: (nominal) positions of the rectified frame's corner pixels in the
    raw frame, upper left, upper right, lower right, lower left.
    """

    name: str = Field(pattern=r"^[A-Za-z0-9_-]{1,64}$")
    marker_rows: int = Field(ge=5, le=128)
    marker_columns: int = Field(ge=5, le=128)
    marker_pitch_px: float = Field(ge=8, le=60)
    marker_diameter_px: float = Field(ge=2, le=40)
    first_marker_px: Point
    raw_width_px: Side
    raw_height_px: Side
    width_px: Side
    height_px: Side
    mm_per_px: float = Field(ge=0.02, le=0.3)
    fps: int = Field(ge=10, le=120)
    gel_width_mm: float = Field(ge=3, le=200)
    gel_height_mm: float = Field(ge=3, le=200)
    gel_margin_mm: Point
    corners_raw_px: Corners

    @staticmethod
    def load(name_or_path: str | Path = DEFAULT_SENSOR) -> "Sensor":
        """The profile of a known name, or of a TOML file, which is named after the file unless it states a name.

        Raises ContractError in one line: unknown sensor, unreadable file, unknown key, or an impossible value.
        """
        path = Path(name_or_path)
        return _read(path) if path.suffix == ".toml" else _known(str(name_or_path))

    @model_validator(mode="after")
    def _can_exist(self) -> Self:
        if not 1.4 < self.marker_pitch_px / self.marker_diameter_px < 8:
            raise ValueError("marker_diameter_px: the pitch must be 1.4 to 8 diameters for the markers to be tracked")
        last = self.marker_rest_px()[-1, -1]
        if min(self.first_marker_px) < 0 or last[0] > self.width_px - 1 or last[1] > self.height_px - 1:
            raise ValueError(f"first_marker_px: the markers must lie in {self.width_px} x {self.height_px} px")
        beyond = np.array([self.gel_width_mm, self.gel_height_mm]) - np.array(self.gel_margin_mm) - self._span_mm
        if min(self.gel_margin_mm) < 0 or beyond.min() < -1e-9:
            raise ValueError(f"gel_margin_mm: the markers must lie on {self.gel_width_mm} x {self.gel_height_mm} mm")
        edges = np.roll(self.corners_raw_px, -1, 0) - np.array(self.corners_raw_px)
        if not (edges[:, 0] * np.roll(edges[:, 1], -1) > edges[:, 1] * np.roll(edges[:, 0], -1)).all():
            raise ValueError("corners_raw_px: must be convex, clockwise in the picture from the upper left")
        return self

    def __str__(self) -> str:
        return self.name

    @property
    def marker_pitch_mm(self) -> float:
        """Distance of neighbouring markers on the gel."""
        return self.marker_pitch_px * self.mm_per_px

    @property
    def _span_mm(self) -> NDArray[np.float64]:
        """From the first to the last marker along u and v, [2]."""
        return np.array([self.marker_columns - 1, self.marker_rows - 1]) * self.marker_pitch_mm

    @property
    def up(self) -> Edge:
        """The edge of the raw frame at which the rectified one has its upper edge: how the camera is mounted."""
        along = np.subtract(self.corners_raw_px[1], self.corners_raw_px[0])
        return EDGES[round(float(np.arctan2(along[1], along[0])) / (np.pi / 2)) % 4]

    @property
    def raw(self) -> FrameSpec:
        """The camera's frame."""
        return FrameSpec(height_px=self.raw_height_px, width_px=self.raw_width_px, rectified=False)

    @property
    def rectified(self) -> FrameSpec:
        """The frame that is tracked and shown to networks."""
        return FrameSpec(height_px=self.height_px, width_px=self.width_px)

    @property
    def markers(self) -> MarkerSpec:
        return MarkerSpec(
            rows=self.marker_rows,
            columns=self.marker_columns,
            pitch_px=self.marker_pitch_px,
            first_px=self.first_marker_px,
        )

    def marker_rest_px(self) -> NDArray[np.float32]:
        """Rest position of each marker: float32 [rows, columns, 2], (u, v)."""
        u = self.first_marker_px[0] + self.marker_pitch_px * np.arange(self.marker_columns)
        v = self.first_marker_px[1] + self.marker_pitch_px * np.arange(self.marker_rows)
        return np.stack(np.meshgrid(u, v), -1).astype(np.float32)


@cache
def _known(name: str) -> Sensor:
    known = sorted(entry.stem for entry in SENSORS.glob("*.toml"))
    if name not in known:
        raise ContractError(
            f"no sensor {name!r}: expected a TOML file or one of {', '.join(known)}{nearest(name, known)}"
        )
    return _read(SENSORS / f"{name}.toml")


def _read(path: Path) -> Sensor:
    try:
        table = read_toml(path)
    except OSError as error:
        raise ContractError(f"cannot read the sensor {path}: {error.strerror}") from error
    try:
        return Sensor.model_validate({"name": path.stem, **table})
    except ValidationError as error:
        raise ContractError(f"{path}: {describe(error, Sensor)}") from error
