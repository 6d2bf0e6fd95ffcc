"""Pictures of the foreign cell's cameras: a Lambertian gel under three point lights, printed dots, shot noise.

Light, print and noise are independent of `simulation.optics`; no code is shared. The light falls on the gel's true
slopes: a stiff gel with a shallow imprint shows little.
"""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from service.contract import Sensor
from service.perception.rectification import CameraCalibration

Image = NDArray[np.uint8]
Floats = NDArray[np.float32]

HEIGHT_MM, BESIDE_MM = 14.0, 14.0  # lights above the gel and beyond its rim; grazing light shows slopes
LIGHTS = (  # colour (blue, green, red), and position in shares of the picture (u, v)
    ((0.15, 0.95, 0.25), (0.0, 0.5)),
    ((0.20, 0.25, 0.95), (1.0, 0.5)),
    ((0.85, 0.35, 0.30), (0.5, 1.0)),
)
AMBIENT, BRIGHT = 0.3, 105.0  # share of ambient light; mean grey level of a flat gel
DOT_ALBEDO, DOT_RIM_PX, DOT_SIZES, DOT_PLACES_PX = 0.3, 0.8, 0.06, 0.35
MOTTLED, MOTTLE_PX = 0.04, 6.0
SHOT_GREY, READ_GREY, ROW_GREY = 0.055, 1.0, 0.4  # variance per grey level; read and row noise at a camera noise of 4
ROUNDS = 5  # fixed-point rounds for the gel that a pixel shows: X = p - U(X); U changes by less than 0.3 per pixel


class Camera:
    """One finger's camera; frames are raw ones, uint8 [h, w, 3] BGR.

    Gel states are [rows, columns, 4]: motion along u and v in mm, pressure, and depth of the imprint, mm.
    """

    def __init__(
        self, sensor: Sensor, seed: int, *, noise_grey: float = 4.0, light: float = 1.0, blur_share: float = 0.0
    ) -> None:
        self.sensor, self.noise_grey, self.blur_share = sensor, noise_grey, blur_share
        rng = np.random.default_rng((seed, 0xF0))
        corners = np.asarray(self.sensor.corners_raw_px) + rng.normal(0.0, 1.5, (4, 2))
        right, bottom = self.sensor.width_px - 1, self.sensor.height_px - 1
        flat = np.array([[0, 0], [right, 0], [right, bottom], [0, bottom]], np.float32)
        self._homography = cv2.getPerspectiveTransform(corners.astype(np.float32), flat).astype(np.float64)
        height, width = self.sensor.raw.shape[:2]
        pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(np.float64)
        at = cv2.perspectiveTransform(pixels.reshape(-1, 1, 2), self._homography).reshape(pixels.shape)
        self._at = np.clip(at, -2.0 * right, 3.0 * right).astype(np.float32)
        inside = np.minimum(np.minimum(at[..., 0], right - at[..., 0]), np.minimum(at[..., 1], bottom - at[..., 1]))
        self._window = np.clip(inside / 4.0 + 1.0, 0.0, 1.0).astype(np.float32)[..., None]
        self._albedo, self._lit = self._printed(rng), [self._light(*one) for one in LIGHTS]
        even = sum(float(flat[self._window > 0].mean()) * float(colour.mean()) for colour, _, flat in self._lit)
        self._bright = light * BRIGHT / ((1.0 + AMBIENT) * even)

    @property
    def calibration(self) -> CameraCalibration:
        return CameraCalibration(
            self._homography, self.sensor.raw, self.sensor.rectified, mm_per_px=self.sensor.mm_per_px
        )

    def raw(self, gel: NDArray[np.floating], frame_seed: int, previous: NDArray[np.floating] | None = None) -> Image:
        """A frame of a gel [rows, columns, 4]; ``previous``: the state one frame earlier, for motion blur.

        Raises ValueError where the gel has another shape.
        """
        expected = (self.sensor.marker_rows, self.sensor.marker_columns, 4)
        if gel.shape != expected:
            raise ValueError(f"gel state has shape {list(gel.shape)}, expected {list(expected)}")
        begun = gel if previous is None else gel - self.blur_share * (gel - previous)
        clean = self._clean(gel) if np.array_equal(begun, gel) else 0.5 * (self._clean(gel) + self._clean(begun))
        rng, share = np.random.default_rng(frame_seed), self.noise_grey / 4.0
        sigma = share * np.sqrt(READ_GREY**2 + SHOT_GREY * clean)
        rows = rng.normal(0.0, share * ROW_GREY, (len(clean), 1, 1))
        frame = clean + sigma * rng.standard_normal(clean.shape, np.float32) + rows
        return np.asarray(np.clip(np.rint(frame), 0, 255), np.uint8)

    def _clean(self, gel: NDArray[np.floating]) -> Floats:
        """The light that reaches the sensor, grey levels [h, w, 3]."""
        felt = self._spread(gel[..., (0, 1, 3)] / self.sensor.mm_per_px)  # px
        rest = self._at
        for _ in range(ROUNDS if gel.any() else 0):
            rest = self._at - _sampled(felt, rest)[..., :2]
        slope_v, slope_u = np.gradient(-felt[..., 2])
        slope = _sampled(np.stack([slope_u, slope_v, felt[..., 2]], -1), rest)[..., :2]
        albedo = _sampled(self._albedo, rest)[..., :1]
        steep = np.sqrt(1.0 + _dot(slope, slope))
        shade = np.zeros_like(slope[..., :1])
        for colour, towards, flat in self._lit:
            facing = np.maximum(flat - _dot(slope, towards), 0.0) / steep
            shade = shade + colour * (AMBIENT * flat + facing)
        return np.asarray(self._bright * albedo * shade * self._window + 12.0 * (1.0 - self._window), np.float32)

    def _light(self, colour: tuple[float, ...], at: tuple[float, float]) -> tuple[Floats, Floats, Floats]:
        """A light's colour, its change by a slope (u, v) [h, w, 2], and its level on a flat gel [h, w, 1]."""
        size = np.array([self.sensor.width_px - 1, self.sensor.height_px - 1]) * self.sensor.mm_per_px
        place = np.array(at) * size + np.sign(np.array(at) - 0.5) * BESIDE_MM
        way = (place - self._at * self.sensor.mm_per_px).astype(np.float32)
        far = np.sqrt(np.square(way).sum(-1, keepdims=True) + HEIGHT_MM**2)
        fall = (0.5 * float(size.max())) ** 2 / np.square(far)
        return np.asarray(colour, np.float32), np.asarray(fall * way / far), np.asarray(fall * HEIGHT_MM / far)

    def _spread(self, lattice: NDArray[np.floating]) -> Floats:
        """Values at the markers [rows, columns, 3] at every rectified pixel; those at the rim are continued."""
        u, v = self.sensor.first_marker_px
        columns = (np.arange(self.sensor.width_px) - u) / self.sensor.marker_pitch_px
        rows = (np.arange(self.sensor.height_px) - v) / self.sensor.marker_pitch_px
        padded = np.pad(lattice, ((1, 1), (1, 1), (0, 0)), mode="edge").astype(np.float32)
        where = np.stack(np.meshgrid(columns + 1.0, rows + 1.0), -1).astype(np.float32)
        return _sampled(padded, where, cv2.INTER_CUBIC)

    def _printed(self, rng: np.random.Generator) -> Floats:
        """The albedo of the gel at rest, in three equal channels [H, W, 3]: mottled paint and soft, uneven dots."""
        height, width = self.sensor.height_px, self.sensor.width_px
        mottle = cv2.GaussianBlur(rng.normal(0.0, 1.0, (height, width)).astype(np.float32), (0, 0), MOTTLE_PX)
        paint = np.asarray(1.0 + MOTTLED * mottle / float(mottle.std()), np.float32)
        places = self.sensor.marker_rest_px().reshape(-1, 2).astype(np.float64)
        places = places + rng.normal(0.0, DOT_PLACES_PX, places.shape)
        radius = 0.5 * self.sensor.marker_diameter_px * rng.normal(1.0, DOT_SIZES, len(places))
        v, u = np.mgrid[:height, :width]
        for (x, y), size in zip(places, radius, strict=True):
            reach = int(size) + 5
            near = np.s_[max(0, int(y) - reach) : int(y) + reach, max(0, int(x) - reach) : int(x) + reach]
            edge = 1.0 / (1.0 + np.exp((np.hypot(u[near] - x, v[near] - y) - size) / DOT_RIM_PX))
            paint[near] *= 1.0 - (1.0 - DOT_ALBEDO) * edge
        return np.repeat(paint[..., None], 3, axis=-1)


def _dot(one: Floats, other: Floats) -> Floats:
    """Scalar products of vectors [h, w, 2], as [h, w, 1]; numpy's sum over an axis of two takes ten times as long."""
    return one[..., :1] * other[..., :1] + one[..., 1:] * other[..., 1:]


def _sampled(source: Floats, at: Floats, interpolation: int = cv2.INTER_LINEAR) -> Floats:
    """``source`` [rows, columns, 3] at positions [h, w, 2]; its rim continues outside.

    Always three channels: with fewer, OpenCV interpolates at 1/32 of a pixel.
    """
    # the stubs want a second map, but OpenCV 5's fast paths read an empty array in its place as a map
    none: Any = None
    return np.asarray(cv2.remap(source, at, none, interpolation, borderMode=cv2.BORDER_REPLICATE), np.float32)
