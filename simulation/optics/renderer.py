"""Gel state -> camera frame: cloth and dots carried by the gel, side light on its slopes, the lens, the sensor.

A gel state is [rows, columns, 3]: (du_mm, dv_mm, pressure in N/mm2) at the rest positions of the markers, in the
finger's own frame (u right, v down). One composed map takes a raw pixel through the lens, back along the gel's motion,
to a precomputed texture; the rest is shading. Same appearance, gel state and frame seed: the same bits.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from service.perception.rectification import CameraCalibration
from simulation.optics import texture as tx
from simulation.optics import used
from simulation.optics.appearance import Appearance
from simulation.optics.lighting import illumination

Image = NDArray[np.uint8]
Floats = NDArray[np.float32]

_DENSE = 5  # the marker lattice is refined to a fifth of its pitch before it is sampled
_COARSE_PX = 5  # raw frames: displacement and shading are evaluated on every fifth pixel, then interpolated
_INVERSE_ITERATIONS = 6  # X = p - U(X) converges like (slope of U)^n; slopes stay below about 0.3
_CONTACT_SHARE = 0.08  # share of the reference pressure at which the held surface's texture is fully visible


@dataclass(frozen=True, slots=True)
class _Lens:
    """Quantities that depend only on the camera, computed once per renderer."""

    homography: NDArray[np.float64]
    map_to_rest: Floats  # [h, w, 2] where each raw pixel lies in the textures, gel at rest
    coarse_index: Floats  # [h / 5, w / 5, 2] position of every fifth raw pixel in the refined marker lattice


@dataclass(frozen=True, slots=True)
class _Scene:
    """A frame before its noise: the light that reaches the sensor for this gel motion, [3] of [h, w]."""

    gel: Floats
    previous: Floats | None
    planes: tuple[Floats, ...]

    def shows(self, gel: Floats, previous: Floats | None) -> bool:
        """Whether the frame belongs to these gel states."""
        if previous is None or self.previous is None:
            return previous is self.previous and np.array_equal(self.gel, gel)
        return np.array_equal(self.gel, gel) and np.array_equal(self.previous, previous)


class Renderer:
    """Draws frames of one finger: about 3 ms per raw frame, 1 ms if the gel did not move; about 15 ms to construct.

    Raw frames are [h, w], rectified ones [H, W], as defined by the appearance's sensor.
    """

    def __init__(self, appearance: Appearance) -> None:
        self.appearance, self.sensor = appearance, appearance.sensor
        self._step_px = self.sensor.marker_pitch_px / _DENSE
        self._shape = self.sensor.raw.shape[:2]
        rng = np.random.Generator(np.random.PCG64(appearance.seed))
        self._lens = _lens(appearance)
        self._albedo, self._relief = _textures(appearance, rng)
        self._light, self._surround = illumination(appearance, self._lens.map_to_rest - tx.MARGIN_PX, rng)
        self._last: _Scene | None = None

    @property
    def homography(self) -> NDArray[np.float64]:
        """Float64 [3, 3]: raw pixel -> rectified pixel."""
        return self._lens.homography.copy()

    @property
    def calibration(self) -> CameraCalibration:
        return CameraCalibration(
            self.homography, self.sensor.raw, self.sensor.rectified, mm_per_px=self.sensor.mm_per_px
        )

    @property
    def blur_share(self) -> float:
        """Exposure time over frame period."""
        return self.appearance.motion_blur_share

    def raw(self, gel: NDArray[np.floating], frame_seed: int, previous: NDArray[np.floating] | None = None) -> Image:
        """Uint8 [h, w, 3] BGR frame of ``gel`` [rows, columns, 3]; ValueError if it is not finite or of another shape.

        Motion blur and the rolling shutter see the motion from ``previous``, the gel state one frame earlier.
        """
        gel = self._checked(gel)
        moves = previous is not None and (self.appearance.motion_blur_share > 0 or self.appearance.rolling_share > 0)
        before = self._checked(previous) if moves and previous is not None else None
        if before is not None and np.array_equal(before[..., :2], gel[..., :2]):
            before = None  # nothing moved: no motion blur, no rolling shutter
        last = self._last
        if last is None or not last.shows(gel, before):
            last = self._last = _Scene(gel, before, self._lit(gel, before))
        return self._grained(last.planes, frame_seed)

    def _lit(self, gel: Floats, previous: Floats | None) -> tuple[Floats, ...]:
        """The frame before its noise: light times albedo times shading, one plane per colour."""
        look = self.appearance
        shift = self._inverse(_refined(gel[..., :2] * np.float32(1 / (self.sensor.mm_per_px * self._step_px))))
        rest_index = self._lens.coarse_index - shift
        gains, touched = _gains(self._slopes(gel, rest_index), look.shading_gain)
        where = self._lens.map_to_rest - self._to_raw(shift * np.float32(self._step_px), cv2.INTER_CUBIC)
        smear = None if previous is None else self._motion_since(gel, previous, rest_index)
        if smear is not None and look.rolling_share > 0:
            where = _rolled(where, smear, look.rolling_share)
        albedo = _remap(self._albedo, where)
        if smear is not None and look.motion_blur_share > 0:
            albedo = self._blurred(albedo, where, smear)
        bumps = None if self._relief is None or not touched.any() else self._bumps(self._relief, where, touched)
        return self._shaded(albedo, bumps, gains)

    def rectified(
        self, gel: NDArray[np.floating], frame_seed: int, previous: NDArray[np.floating] | None = None
    ) -> Image:
        """Uint8 [H, W, 3]: the raw frame through the same warp as the service's rectifier."""
        return self.rectify(self.raw(gel, frame_seed, previous))

    def rectify(self, raw: Image) -> Image:
        """Uint8 [H, W, 3] from a raw [h, w, 3], bilinear."""
        size = (self.sensor.width_px, self.sensor.height_px)
        return np.asarray(cv2.warpPerspective(raw, self._lens.homography, size, flags=cv2.INTER_LINEAR), np.uint8)

    def _inverse(self, motion: Floats) -> Floats:
        """Displacement of the gel at each coarse raw pixel, [h / 5, w / 5, 2], in steps of the refined lattice."""
        at = self._lens.coarse_index
        shift = np.zeros_like(at)
        for _ in range(_INVERSE_ITERATIONS if motion.any() else 0):
            shift = _remap(motion, at - shift)[..., :2]
        return shift

    def _slopes(self, gel: Floats, rest_index: Floats) -> Floats:
        """Imprint height and slopes (h, dh/du, dh/dv) per marker pitch at the coarse raw pixels, [h / 5, w / 5, 3]."""
        height = gel[..., 2] * np.float32(1 / self.appearance.reference_pressure_n_per_mm2)
        slope_v, slope_u = np.gradient(height)
        return np.asarray(_remap(_refined(np.stack([height, slope_u, slope_v], -1)), rest_index), np.float32)

    def _motion_since(self, gel: Floats, previous: Floats, rest_index: Floats) -> Floats:
        """Motion from ``previous`` to ``gel`` at each raw pixel, [h, w, 2], rectified px."""
        change = _refined((gel[..., :2] - previous[..., :2]) * np.float32(1 / self.sensor.mm_per_px))
        return self._to_raw(np.ascontiguousarray(_remap(change, rest_index)[..., :2]))

    def _blurred(self, albedo: Floats, where: Floats, smear: Floats) -> Floats:
        """The albedo seen while the gel moved: the mean of the positions at the exposure's start and end."""
        earlier = _remap(self._albedo, where + np.float32(self.appearance.motion_blur_share) * smear)
        return np.asarray(cv2.addWeighted(albedo, 0.5, earlier, 0.5, 0), np.float32)

    def _bumps(self, relief: Floats, where: Floats, touched: Floats) -> Floats:
        """The held surface's texture [h, w] as a fraction of the light."""
        bumps = _remap(relief, where)
        bumps *= self._to_raw(touched * np.float32(self.appearance.object_texture_gain))
        return bumps

    def _shaded(self, albedo: Floats, bumps: Floats | None, gains: Floats) -> tuple[Floats, ...]:
        """Three planes [h, w]: light times albedo times slope shading."""
        planes = []
        for channel, sign in enumerate((0.2, -0.8, 1.0)):  # a bump is lit red on one side and shaded green on the other
            level = self._to_raw(gains[channel])
            if bumps is not None:
                cv2.scaleAdd(bumps, sign, level, dst=level)
            level *= self._light[channel]
            level *= albedo
            planes.append(level)
        return tuple(planes)

    def _grained(self, planes: tuple[Floats, ...], frame_seed: int) -> Image:
        """Uint8 [h, w, 3]: the planes, the surroundings of the gel, and the sensor's noise."""
        sigma = self.appearance.noise_sigma_grey
        noise = _noise(frame_seed, *self._shape) if sigma > 0 else None
        channels = []
        for channel, plane in enumerate(planes):
            level = plane if noise is None else cv2.scaleAdd(noise[channel], sigma, plane)
            channels.append(cv2.add(level, self._surround[channel], dtype=cv2.CV_8U))  # rounds and saturates
        return np.asarray(cv2.merge(channels), np.uint8)

    def _to_raw(self, coarse: Floats, interpolation: int = cv2.INTER_LINEAR) -> Floats:
        """Every-fifth-pixel field [h / 5, w / 5, ...] to all raw pixels [h, w, ...]; a view into something wider.

        Cubic for the gel's motion (a third less error than linear), linear for light; the lens is mapped pixel by
        pixel.
        """
        full = cv2.resize(coarse, None, fx=_COARSE_PX, fy=_COARSE_PX, interpolation=interpolation)
        return np.asarray(full, np.float32)[: self._shape[0], : self._shape[1]]

    def _checked(self, gel: NDArray[np.floating]) -> Floats:
        expected = (self.sensor.marker_rows, self.sensor.marker_columns, 3)
        if gel.shape != expected:
            raise ValueError(f"gel state has shape {list(gel.shape)}, expected {list(expected)}")
        if not np.isfinite(gel).all():
            raise ValueError("gel state holds a non-finite number")
        return gel.astype(np.float32)


def _refined(lattice: Floats) -> Floats:
    """The lattice [rows, columns, 2 or 3] with one replicated node around it, in steps of a fifth of its pitch.

    Node k lies at index 5 k + 7. Always three channels: with two, OpenCV interpolates at 1/32 of a step.
    """
    rows, columns, channels = lattice.shape
    padded = np.zeros((rows + 2, columns + 2, 3), np.float32)
    padded[1:-1, 1:-1, :channels] = lattice
    padded[0], padded[-1] = padded[1], padded[-2]
    padded[:, 0], padded[:, -1] = padded[:, 1], padded[:, -2]
    return np.asarray(cv2.resize(padded, None, fx=_DENSE, fy=_DENSE, interpolation=cv2.INTER_CUBIC), np.float32)


def _remap(source: NDArray[Any], at: Floats) -> NDArray[Any]:
    """``source`` at positions [h, w, 2], bilinear; its rim continues outside."""
    # the stubs want a second map, but OpenCV 5's fast paths read an empty array in its place as a map
    none: Any = None
    return np.asarray(cv2.remap(source, at, none, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def _gains(felt: Floats, shading_gain: float) -> tuple[Floats, Floats]:
    """Colour gains [B G R, ...] and touch from (height, slope u, slope v): red light from the left, green right."""
    height, slope_u, slope_v = felt[..., 0], felt[..., 1], felt[..., 2]
    bright = 1 + 0.10 * shading_gain * np.tanh(height)
    red = np.tanh(shading_gain * (1.2 * slope_u + 0.4 * slope_v))
    green = np.tanh(shading_gain * (-1.1 * slope_u - 0.6 * slope_v))
    blue = np.tanh(shading_gain * 0.5 * slope_v)
    gains = np.stack([bright + 0.3 * blue, bright + 0.4 * green, bright + 0.5 * red]).astype(np.float32)
    return gains, np.clip(height / _CONTACT_SHARE, 0, 1).astype(np.float32)


def _rolled(where: Floats, smear: Floats, rolling_share: float) -> Floats:
    """The position of each row at its readout, [h, w, 2].

    Rows are read from the top: the first is early by the whole readout time, the last by none.
    """
    earliness = np.linspace(1, 0, len(where), dtype=np.float32)[:, None, None]
    return np.asarray(where + smear * (rolling_share * earliness), np.float32)


def _noise(frame_seed: int, height: int, width: int) -> Floats:
    """Float32 [3, height, width], unit variance: a random crop of the noise bank, or of its negative."""
    rng = np.random.Generator(np.random.PCG64(frame_seed))
    banks = tx.noise_bank(height, width)
    top, left, sign = (int(n) for n in rng.integers((banks.shape[2] - height, banks.shape[3] - width, 2)))
    return banks[sign, :, top : top + height, left : left + width]


def _lens(look: Appearance) -> _Lens:
    sensor = look.sensor
    right, bottom = sensor.width_px - 1, sensor.height_px - 1
    flat = np.asarray([[0, 0], [right, 0], [right, bottom], [0, bottom]], np.float32)
    homography = cv2.getPerspectiveTransform(np.asarray(look.corners_raw_px, np.float32), flat)

    def rectified_of(u: NDArray[np.floating], v: NDArray[np.floating]) -> Floats:
        points = np.stack(np.meshgrid(u, v), -1)
        mapped = cv2.perspectiveTransform(points.reshape(-1, 1, 2), homography).reshape(points.shape)
        limit = 4.0 * sensor.width_px  # beyond it the pixel is never gel; keeps fixed-point maps in range
        return np.clip(mapped, -limit, limit).astype(np.float32)

    full = rectified_of(np.arange(sensor.raw_width_px, dtype=float), np.arange(sensor.raw_height_px, dtype=float))
    half = (_COARSE_PX - 1) / 2
    columns, rows = -(-sensor.raw_width_px // _COARSE_PX), -(-sensor.raw_height_px // _COARSE_PX)
    coarse = rectified_of(np.arange(columns) * _COARSE_PX + half, np.arange(rows) * _COARSE_PX + half)
    first, step_px = np.asarray(sensor.first_marker_px, np.float32), sensor.marker_pitch_px / _DENSE
    index = (coarse - first) / step_px + (_DENSE + _DENSE // 2)
    return _Lens(np.asarray(homography, np.float64), full + tx.MARGIN_PX, index.astype(np.float32))


def _textures(look: Appearance, rng: np.random.Generator) -> tuple[Floats, Floats | None]:
    """Float32 [H, W] each, at rest: albedo (1 is plain cloth) and, if visible, relief of the held surface (-1..1).

    Effects that are off are not computed, but their random numbers are still drawn, so that later draws do not change.
    """
    sensor, kind, period_px = look.sensor, look.object_texture, look.object_texture_period_px
    fabric = tx.cloth(rng, sensor, look.cloth_period_px, look.cloth_contrast, look.worn)
    share = look.used_share
    off_px = used.dots_off_px(look.seed, sensor, share) if share > 0 else None
    darkness = look.dot_darkness * (1 - share * (1 - used.PALE))
    albedo = fabric * (1 - darkness * tx.dot_cover(rng, sensor, look.missing_dots_share, off_px))
    if share > 0:
        albedo = used.soiled(albedo, look.seed, sensor, share)
    bumps = tx.draw_bumps(rng, sensor, kind, period_px)
    relief = (
        _defocused(tx.relief(bumps, sensor, kind, period_px), look.defocus_px) if look.object_texture_gain else None
    )
    return _defocused(np.clip(albedo, 0, 1.6), look.defocus_px), relief


def _defocused(texture: Floats, blur_px: float) -> Floats:
    return np.asarray(cv2.GaussianBlur(texture, (0, 0), blur_px) if blur_px > 0 else texture, np.float32)
