"""What a used sensor shows and a new one does not, after one raw frame of a GelSlim (2018/19).

The frame was rectified by `calibrate`. Measured on it: the light, the flares' colours, and how far dots are off their
places and how pale. Set by eye: the flares' extents, and number, size and look of debris and glue. Its dots were no
more blurred than rendered ones (16 to 84 % of a rim: 1.3 px at the top, 2.0 px at the bottom; rendered 2.0 px), so a
used sensor is not blurred further.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from service.contract import Sensor

Floats = NDArray[np.float32]

# Light on the gel, grey levels: blue, green and red in the middles of 4 x 4 fields, from the upper left.
LIGHT_GREY = np.array(
    [
        [[16, 19, 16, 15], [13, 18, 15, 11], [9, 12, 13, 10], [7, 10, 8, 9]],
        [[131, 142, 183, 200], [120, 133, 162, 169], [116, 122, 141, 136], [113, 116, 134, 129]],
        [[82, 89, 1, 0], [82, 89, 20, 1], [60, 75, 26, 20], [42, 71, 20, 34]],
    ],
    np.float32,
)
# Flares of the LEDs in the lower corners: u, shares of the width and the height, grey levels of blue, green and red.
FLARES = ((0.0, 0.06, 0.12, (27, 210, 0)), (1.0, 0.12, 0.12, (45, 159, 152)))
OFF_PITCH = 0.0085  # RMS distance of a dot from its place, along each axis
PALE = 0.84  # darkness of a dot, as a share of a rendered one's
# Debris and glue: half axes in pitches, brightness as a share of the gel's, share of the gel that it hides.
PATCHES = ((0.6, 0.8, 1.5, 1.0), (0.7, 0.3, 1.2, 0.6), (0.7, 0.3, 1.2, 0.6), (0.4, 0.3, 1.2, 0.6))


def light_grey(u: NDArray[np.floating], v: NDArray[np.floating]) -> Floats:
    """The light [h, w, 3] on the gel of a used sensor, grey levels; u, v [h, w]: shares of the gel's size."""
    across, down = (np.clip(4 * at - 0.5, 0, 3).astype(np.float32) for at in (u, v))
    real = cv2.remap(np.ascontiguousarray(LIGHT_GREY.transpose(1, 2, 0)), across, down, cv2.INTER_LINEAR)
    for corner, width, height, grey in FLARES:
        away = np.clip(np.abs(u - corner) / width + np.abs(v - 1.0) / height, 0, 1)[..., None]
        real = real * away + np.array(grey, np.float32) * (1 - away)
    return np.asarray(real, np.float32)


def dots_off_px(seed: int, sensor: Sensor, share: float) -> Floats:
    """How far each dot is printed off its place [rows + 2, columns + 2, 2], px."""
    shape = (sensor.marker_rows + 2, sensor.marker_columns + 2, 2)
    spread_px = share * OFF_PITCH * sensor.marker_pitch_px
    return np.random.default_rng([seed, 1]).normal(0.0, spread_px, shape).astype(np.float32)


def soiled(albedo: Floats, seed: int, sensor: Sensor, share: float) -> Floats:
    """The albedo [H, W] with debris and glue on it, each somewhere on the gel."""
    rng, (height, width) = np.random.default_rng([seed, 2]), albedo.shape
    v, u = np.mgrid[:height, :width].astype(np.float32)
    for along, across, bright, hides in PATCHES:
        x, y, turn = u - rng.uniform(0, width), v - rng.uniform(0, height), rng.uniform(0, np.pi)
        cos, sin = np.cos(turn), np.sin(turn)
        away_px = np.hypot((x * cos + y * sin) / along, (y * cos - x * sin) / across)
        cover = share * hides * np.clip(sensor.marker_pitch_px - away_px, 0, 1)
        albedo = np.asarray(albedo + cover * (bright - albedo), np.float32)
    return albedo
