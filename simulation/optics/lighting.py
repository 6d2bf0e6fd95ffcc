"""The LEDs' light on the gel, and the surroundings of the gel in the picture."""

import numpy as np
from numpy.typing import NDArray

from service.contract import Sensor
from simulation.optics import used
from simulation.optics.appearance import Appearance

Floats = NDArray[np.float32]


def illumination(look: Appearance, at: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Light on the gel [3, h, w] (grey levels per unit of albedo) and the surroundings of the gel [3, h, w].

    ``at`` [h, w, 2]: where each raw pixel lies in the rectified image, gel at rest, px. GelSlim: green from LEDs at the
    lower corners, an olive-red cast towards the upper left and centre, brightest along the lower edge; beside the gel
    dark housing, a cable and reflections.
    """
    width, height = look.sensor.width_px, look.sensor.height_px
    u, v, s = at[..., 0] / (width - 1), at[..., 1] / (height - 1), look.light_shift
    corners = np.exp(-(((u - 0.02 - s) / 0.45) ** 2 + ((v - 1.0) / 0.55) ** 2))
    corners = corners + np.exp(-(((u - 0.98 - s) / 0.45) ** 2 + ((v - 1.0) / 0.55) ** 2))
    edge = np.exp(-(((v - 1.02) / 0.16) ** 2))
    cast = np.exp(-(((u - 0.33 + s) / 0.5) ** 2 + ((v - 0.22) / 0.6) ** 2))
    green = 0.30 + 0.46 * corners + 0.22 * edge + 0.16 * cast
    red = 0.20 + 0.06 * corners + 0.20 * edge + 0.34 * cast
    blue = 0.17 + 0.16 * corners + 0.20 * edge + 0.05 * cast
    light = (np.stack([blue, green, red], -1) + look.ambient) * look.light_bgr * (look.exposure * 255)
    if look.used_share > 0:
        real = used.light_grey(u, v) * look.light_bgr * look.exposure
        light = (1 - look.used_share) * light + look.used_share * real
    margin = np.minimum(np.minimum(u, 1 - u) * width, np.minimum(v, 1 - v) * height)
    gel = np.clip(margin / 6 + 1.5, 0, 1)[..., None]
    return _planes(light * gel), _planes(_housing(rng, look.sensor, look.exposure) * (1 - gel))


def _housing(rng: np.random.Generator, sensor: Sensor, exposure: float) -> Floats:
    """Float32 [h, w, 3]: black print, a grey cable and soft green reflections outside the gel."""
    v, u = np.mgrid[: sensor.raw_height_px, : sensor.raw_width_px].astype(np.float32)
    middle, bottom, side = 0.5 * sensor.raw_width_px, sensor.raw_height_px - 2, rng.choice([-1, 1])
    cable = np.exp(-(((u - middle - side * (middle - 8.5 - 0.22 * v)) / 7) ** 2))
    glow = np.exp(-(((v - bottom) / 50) ** 2)) * np.exp(-(((np.abs(u - middle) - 120) / 45) ** 2))
    tint = np.stack([18 + 40 * cable + 30 * glow, 22 + 42 * cable + 90 * glow, 17 + 40 * cable + 26 * glow], -1)
    return np.asarray(exposure * tint, np.float32)


def _planes(image: NDArray[np.floating]) -> Floats:
    """[H, W, 3] to contiguous float32 [3, H, W]: whole planes multiply several times faster than interleaved colour."""
    return np.ascontiguousarray(np.moveaxis(image, -1, 0), np.float32)
