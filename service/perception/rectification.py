"""From the raw camera frame to the rectified one in which the markers form a regular grid.

A calibration file is TOML: ``schema_version = 1`` and one table per finger, ``[left]`` and ``[right]``, with ``raw_px =
[width, height]``, ``rectified_px = [width, height]`` and ``homography`` (3 rows of 3): pixels of the raw frame to
pixels of the rectified one, u right, v down, pixel centres at integers. ``mm_per_px``, of the rectified frame, is
missing in older files.

Where the lens bends the rows, the homography starts from its ideal picture: ``lens_centre_px``, ``lens_scale_px``,
``lens_k`` (k1, k2). Where the gel does, ``warp_low_px``, ``warp_high_px`` and ``warp_px`` (2 rows of coefficients)
correct its result (:mod:`service.perception.lens`). Measurements are stored with it: ``date``, ``serial``,
``residual_px``, ``found_share``, ``fingerprint`` (:mod:`service.perception.markers.fingerprint`), and ``light``
(:mod:`service.perception.light`), which is missing in older files.
"""

import math
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError

from service.contract import FINGERS, ContractError, Finger, FrameSpec, ModelCard
from service.contract.frames import Contract
from service.contract.refusals import describe, nearest
from service.contract.toml import parse_toml, toml_text
from service.perception.lens import Lens, Projection, Warp, order_of
from service.perception.light import check_light
from service.perception.markers.fingerprint import check_fingerprint

SCHEMA_VERSION = 1
Pair = Annotated[list[float], Field(min_length=2, max_length=2)]
Size = Annotated[list[int], Field(min_length=2, max_length=2)]  # width, height
_TOGETHER = (
    ("lens_centre_px", "lens_scale_px", "lens_k"),
    ("warp_low_px", "warp_high_px", "warp_px"),
    ("date", "residual_px", "found_share"),
)
_MIN_AREA_SHARE = 0.02  # least share of the raw frame that the rectified one covers


class CalibrationError(ValueError):
    """A calibration that cannot be used; the text names the file, the finger and the fault."""


@dataclass(frozen=True, slots=True)
class Measured:
    """Provenance of a calibration.

    ISO ``date``; ``serial`` of the camera, "" if it has none; ``residual_px``, RMS distance of the markers from the
    regular grid in rectified px; ``found_share`` of the grid's markers; ``fingerprint`` and ``light`` of the gel, "" if
    not known.
    """

    date: str
    serial: str
    residual_px: float
    found_share: float
    fingerprint: str
    light: str = ""


@dataclass(frozen=True)
class CameraCalibration:
    """One camera: its raw and rectified frames, and the homography (float64 [3, 3], raw to rectified).

    Raises CalibrationError if the homography is not finite, degenerate, or maps (almost) none of the raw frame to the
    rectified one, or if lens or warp would make two places coincide.
    """

    homography: NDArray[np.float64]
    raw: FrameSpec
    rectified: FrameSpec
    lens: Lens | None = None
    warp: Warp | None = None
    measured: Measured | None = None
    mm_per_px: float | None = None  # of the rectified frame, None if not known

    def __post_init__(self) -> None:
        matrix = np.asarray(self.homography, np.float64)
        if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
            raise CalibrationError(f"homography must be 3 x 3 finite numbers, got {matrix.tolist()}")
        scale = np.linalg.norm(matrix)
        if not scale > 0 or abs(np.linalg.det(matrix / scale)) < 1e-12:
            raise CalibrationError("homography is degenerate (its determinant vanishes)")
        object.__setattr__(self, "homography", matrix)
        self._check_view(matrix)
        if self.lens is not None and not self.lens.one_to_one(self.raw.width_px, self.raw.height_px):
            raise CalibrationError("lens_k folds the raw frame")
        if self.warp is not None and not self.warp.one_to_one():
            raise CalibrationError("warp_px folds the rectified frame")

    @property
    def projection(self) -> Projection:
        """The projection from the raw frame to the rectified one."""
        return Projection(self.homography, self.lens, self.warp)

    @cached_property
    def lookup(self) -> tuple[NDArray[np.int16], NDArray[np.uint16]]:
        """Where each rectified pixel lies in the raw frame, for ``cv2.remap``. With a warp this takes 0.3 s, once."""
        width, height = self.rectified.width_px, self.rectified.height_px
        grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(np.float64)
        source = self.projection.raw(grid.reshape(-1, 2)).reshape(grid.shape)
        limit = float(4 * max(self.raw.width_px, self.raw.height_px))
        source = np.clip(source, -limit, limit).astype(np.float32)
        table, fraction = cv2.convertMaps(source[..., 0], source[..., 1], cv2.CV_16SC2)
        return np.asarray(table, np.int16), np.asarray(fraction, np.uint16)

    def _check_view(self, matrix: NDArray[np.float64]) -> None:
        width, height = self.rectified.width_px, self.rectified.height_px
        corners = np.array([(0, 0, 1), (width, 0, 1), (width, height, 1), (0, height, 1)], np.float64)
        view = corners @ np.linalg.inv(matrix).T
        depth = view[:, 2]
        if not (np.all(depth > 0) or np.all(depth < 0)) or np.abs(depth).min() < 1e-9 * np.abs(depth).max():
            raise CalibrationError("homography puts the horizon inside the rectified frame")
        quad = (view[:, :2] / depth[:, None]).astype(np.float32)
        frame = np.array(
            [(0, 0), (self.raw.width_px, 0), (self.raw.width_px, self.raw.height_px), (0, self.raw.height_px)],
            np.float32,
        )
        if not cv2.isContourConvex(quad[:, None]):
            raise CalibrationError("homography folds the rectified frame")
        shared, _ = cv2.intersectConvexConvex(quad[:, None], frame[:, None])
        if not shared > _MIN_AREA_SHARE * self.raw.width_px * self.raw.height_px:
            raise CalibrationError("homography takes the rectified frame from outside the raw one")


@dataclass(frozen=True, slots=True)
class Calibration:
    """The calibration of a cell: one camera per finger."""

    left: CameraCalibration
    right: CameraCalibration

    def camera(self, finger: Finger) -> CameraCalibration:
        return self.left if finger == "left" else self.right

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a calibration file; raise CalibrationError, or FileNotFoundError, with one clear line."""
        return cls.parse(Path(path).read_bytes(), path)

    @classmethod
    def parse(cls, content: bytes, path: str | Path) -> Self:
        """Parse a calibration file's bytes; raise CalibrationError with one clear line, which names the path."""
        try:
            table = parse_toml(content, path)
        except ContractError as error:
            raise CalibrationError(str(error)) from error
        if table.get("schema_version") != SCHEMA_VERSION:
            raise CalibrationError(
                f"{path} has schema_version {table.get('schema_version')!r}, expected {SCHEMA_VERSION}"
            )
        unknown = set(table) - {"schema_version", *FINGERS}
        if unknown:
            raise CalibrationError(f"{path}: {min(unknown)} is not used{nearest(min(unknown), FINGERS)}")
        left, right = (_camera(table, finger, path) for finger in FINGERS)
        if left.rectified != right.rectified:
            sizes = " and ".join(f"{one.rectified.width_px} x {one.rectified.height_px}" for one in (left, right))
            raise CalibrationError(f"{path} rectifies left and right to {sizes}; expected one size for both")
        return cls(left, right)

    def unlike(self, card: ModelCard) -> str:
        """How the rectified frames differ from those that a model reads, as a predicate; empty if they do not."""
        size_px, expected_px = self.left.rectified.shape[1::-1], card.frame.shape[1::-1]
        scales, expected = (self.left.mm_per_px, self.right.mm_per_px), card.profile.mm_per_px
        remedy = f"calibrate with their sensor's profile ({card.profile}), or serve models for this sensor"
        if size_px != expected_px:
            return f"rectifies to {size_px} (width, height), the models expect {expected_px}: {remedy}"
        if wrong := [one for one in scales if one is not None and not math.isclose(one, expected, rel_tol=1e-3)]:
            return f"rectifies to {wrong[0]:g} mm per px, the models expect {expected:g}: {remedy}"
        return ""

    def save(self, path: str | Path) -> None:
        """Write the file that :meth:`load` reads back exactly."""
        tables = {"schema_version": SCHEMA_VERSION} | {finger: _table(self.camera(finger)) for finger in FINGERS}
        Path(path).write_text(toml_text(tables), encoding="utf-8")


class _CameraTable(Contract):
    """A finger's table in the file."""

    raw_px: Size
    rectified_px: Size
    mm_per_px: float | None = Field(default=None, gt=0)
    homography: list[list[float]]
    lens_centre_px: Pair | None = None
    lens_scale_px: float | None = None
    lens_k: Pair | None = None
    warp_low_px: Pair | None = None
    warp_high_px: Pair | None = None
    warp_px: list[list[float]] | None = None
    date: str | None = None
    serial: str = ""
    residual_px: float | None = None
    found_share: float | None = None
    fingerprint: str = ""
    light: str = ""

    def check_whole(self) -> None:
        """Raise ValueError where only a part of a lens, a warp or a measurement is there: it would not be used."""
        for names in _TOGETHER:
            missing = [name for name in names if getattr(self, name) is None]
            if 0 < len(missing) < len(names):
                raise ValueError(f"{missing[0]}: missing; expected {', '.join(names)} together, or none of them")

    def lens(self) -> Lens | None:
        if self.lens_centre_px is None or self.lens_scale_px is None or self.lens_k is None:
            return None
        return Lens((self.lens_centre_px[0], self.lens_centre_px[1]), self.lens_scale_px, *self.lens_k)

    def warp(self) -> Warp | None:
        if self.warp_px is None or self.warp_low_px is None or self.warp_high_px is None:
            return None
        coefficients = np.array(self.warp_px, np.float64)
        if coefficients.ndim != 2 or len(coefficients) != 2:
            raise ValueError(f"warp_px has {len(self.warp_px)} rows, expected 2")
        order_of(coefficients.shape[1])
        return Warp(np.array(self.warp_low_px), np.array(self.warp_high_px), coefficients)

    def measured(self) -> Measured | None:
        if self.date is None or self.residual_px is None or self.found_share is None:
            return None
        check_fingerprint(self.fingerprint)
        check_light(self.light)
        return Measured(self.date, self.serial, self.residual_px, self.found_share, self.fingerprint, self.light)


def _table(camera: CameraCalibration) -> dict[str, Any]:
    lens, warp, measured = camera.lens, camera.warp, camera.measured
    table: dict[str, Any] = {
        "raw_px": camera.raw.shape[1::-1],
        "rectified_px": camera.rectified.shape[1::-1],
        "mm_per_px": camera.mm_per_px,
        "homography": camera.homography.tolist(),
    }
    if lens is not None:
        table |= {"lens_centre_px": lens.centre_px, "lens_scale_px": lens.scale_px, "lens_k": [lens.k1, lens.k2]}
    if warp is not None:
        table |= {"warp_low_px": warp.low.tolist(), "warp_high_px": warp.high.tolist()}
        table["warp_px"] = warp.coefficients.tolist()
    return table | asdict(measured) if measured is not None else table


def _camera(table: dict[str, Any], finger: Finger, path: str | Path) -> CameraCalibration:
    if not isinstance(table.get(finger), dict):
        raise CalibrationError(f"{path} lacks the table [{finger}]")
    try:
        entry = _CameraTable.model_validate(table[finger])
        entry.check_whole()
        raw, rectified = _spec(entry.raw_px, rectified=False), _spec(entry.rectified_px, rectified=True)
        matrix = np.array(entry.homography, np.float64)
        parts = entry.lens(), entry.warp(), entry.measured(), entry.mm_per_px
        return CameraCalibration(matrix, raw, rectified, *parts)
    except ValidationError as error:
        raise CalibrationError(f"{path} [{finger}]: {describe(error, _CameraTable)}") from error
    except ValueError as error:
        raise CalibrationError(f"{path} [{finger}]: {error}") from error


def _spec(size: list[int], *, rectified: bool) -> FrameSpec:
    width, height = size
    return FrameSpec(width_px=width, height_px=height, rectified=rectified)


class Rectifier:
    """Warps raw frames by a table computed once: bilinear, exact to 1/32 px, black outside the raw frame."""

    def __init__(self, camera: CameraCalibration) -> None:
        self.camera = camera
        self._table, self._fraction = camera.lookup

    def apply(self, raw: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Rectified uint8 [height, width, 3] from the raw BGR frame; ContractError if that has another size."""
        self.camera.raw.check(raw)
        warped = cv2.remap(raw, self._table, self._fraction, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        return np.asarray(warped, np.uint8)
