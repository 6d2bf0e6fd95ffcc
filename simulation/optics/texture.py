"""Textures of the gel and its picture: cloth, dots, the LEDs' light, the camera's noise.

Everything here is made once per appearance; a frame only looks it up. Textures live in rest coordinates of the
rectified image (1 px of the rectified image = 1 px of the texture) with a margin that stretching can pull in.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from service.contract import Sensor

MARGIN_PX = 30
SPOT_PX, GRAIN_PX = 24, 4
RELIEFS = ("smooth", "layers", "ribs", "print")

Image = NDArray[np.uint8]
Floats = NDArray[np.float32]


def texture_grid(sensor: Sensor) -> tuple[Floats, Floats]:
    """(u [1, W], v [H, 1]) of the texture's pixels in rectified coordinates, float32."""
    u = np.arange(-MARGIN_PX, sensor.width_px + MARGIN_PX, dtype=np.float32)[None, :]
    v = np.arange(-MARGIN_PX, sensor.height_px + MARGIN_PX, dtype=np.float32)[:, None]
    return u, v


def dot_cover(rng: np.random.Generator, sensor: Sensor, missing_share: float, off_px: Floats | None = None) -> Floats:
    """Float32 [H, W] in 0..1: the share of each texture pixel that a black dot covers.

    Dots have a soft rim one pixel wide, and small random variations of radius and opacity as if dabbed by hand;
    ``missing_share`` of them have worn off; ``off_px`` [rows + 2, columns + 2, 2]: how far they are off their places.
    """
    u, v = texture_grid(sensor)
    (first_u, first_v), pitch = sensor.first_marker_px, sensor.marker_pitch_px
    column, row = np.rint((u - first_u) / pitch), np.rint((v - first_v) / pitch)
    shape = (sensor.marker_rows + 2, sensor.marker_columns + 2)
    rows = np.clip(row + 1, 0, shape[0] - 1).astype(np.intp)
    columns = np.clip(column + 1, 0, shape[1] - 1).astype(np.intp)
    across, down = u - first_u - pitch * column, v - first_v - pitch * row
    if off_px is not None:
        across, down = across - off_px[rows, columns, 0], down - off_px[rows, columns, 1]
    distance = np.hypot(across, down)
    radius = sensor.marker_diameter_px / 2 * rng.normal(1.0, 0.05, shape)
    opacity, lots = rng.uniform(0.85, 1.0, radius.shape), rng.random(radius.shape)
    if missing_share > 0:
        opacity *= lots >= missing_share
    opacity[[0, -1], :] = 0  # the printed grid ends; beyond it there is cloth only
    opacity[:, [0, -1]] = 0
    cover: Floats = (np.clip(radius[rows, columns] - distance + 0.5, 0, 1) * opacity[rows, columns]).astype(np.float32)
    return cover


def coarse_noise(rng: np.random.Generator, sensor: Sensor, cell_px: int) -> Floats:
    """The random numbers of `smooth_noise`, one per cell."""
    u, v = texture_grid(sensor)
    shape = (v.shape[0] // cell_px + 3, u.shape[1] // cell_px + 3)
    return rng.standard_normal(shape).astype(np.float32)


def smoothed(coarse: Floats, sensor: Sensor, cell_px: int) -> Floats:
    """Float32 [H, W] interpolated from `coarse_noise`, one number every ``cell_px`` pixels."""
    import cv2

    u, v = texture_grid(sensor)
    full = cv2.resize(coarse, None, fx=cell_px, fy=cell_px, interpolation=cv2.INTER_CUBIC)
    field: Floats = np.ascontiguousarray(full[cell_px : cell_px + v.shape[0], cell_px : cell_px + u.shape[1]])
    return field


def smooth_noise(rng: np.random.Generator, sensor: Sensor, cell_px: int) -> Floats:
    """Float32 [H, W], roughly unit variance, varying over about ``cell_px`` pixels."""
    return smoothed(coarse_noise(rng, sensor, cell_px), sensor, cell_px)


def worn_spots(coarse: Floats, sensor: Sensor, worn: float) -> Floats:
    """Float32 [H, W] in 0..1: wear of the cloth, 1 is worn through."""
    spots: Floats = np.clip(smoothed(coarse, sensor, SPOT_PX) - 1.2, 0, 1) * worn
    return spots


def cloth(rng: np.random.Generator, sensor: Sensor, period_px: float, contrast: float, worn: float) -> Floats:
    """Float32 [H, W], mean 1: a plain weave seen by the camera, with thick and thin yarns and worn spots."""
    u, v = texture_grid(sensor)
    sway = 0.8 * smooth_noise(rng, sensor, 40)
    warp_yarn = np.sin(2 * np.pi * (u + sway) / period_px)
    weft_yarn = np.sin(2 * np.pi * (v - sway) / period_px)
    weave = warp_yarn * weft_yarn + 0.4 * (warp_yarn + weft_yarn) + 0.5 * smooth_noise(rng, sensor, 3)
    noise = coarse_noise(rng, sensor, SPOT_PX)  # drawn even where nothing is worn, so that later draws do not change
    if worn <= 0:
        return np.asarray(1 + contrast * weave, np.float32)
    spots = worn_spots(noise, sensor, worn)
    pattern: Floats = (1 + contrast * weave * (1 - spots) - 0.35 * spots).astype(np.float32)
    return pattern


class Bumps(NamedTuple):
    """Random parts of a relief: its grain, the start of its pattern, its blotches."""

    grain: Floats
    phase: float
    blotches: Floats | None


def draw_bumps(rng: np.random.Generator, sensor: Sensor, kind: str, period_px: float) -> Bumps:
    """The random numbers of `relief`. Raises ValueError for an unknown kind."""
    if kind not in RELIEFS:
        raise ValueError(f"object texture {kind!r}, expected {', '.join(RELIEFS[:-1])} or {RELIEFS[-1]}")
    grain, phase = coarse_noise(rng, sensor, GRAIN_PX), rng.uniform(0, 2 * np.pi)
    return Bumps(grain, phase, coarse_noise(rng, sensor, max(2, round(period_px))) if kind == "print" else None)


def relief(bumps: Bumps, sensor: Sensor, kind: str, period_px: float) -> Floats:
    """Float32 [H, W] in -1..1: the held surface's own texture as side light shows it through the cloth.

    ``kind``: "smooth" (fine grain only), "layers" (horizontal lines of a 3D print), "ribs" (vertical knurling of a
    cap), "print" (blotches of a label).
    """
    u, v = texture_grid(sensor)
    pattern: NDArray[np.floating] = 0.25 * smoothed(bumps.grain, sensor, GRAIN_PX)
    if kind == "layers":
        pattern = np.sin(2 * np.pi * (v + 0.02 * u) / period_px + bumps.phase) + pattern
    elif kind == "ribs":
        pattern = np.sin(2 * np.pi * (u + 0.02 * v) / period_px + bumps.phase) + pattern
    elif bumps.blotches is not None:
        pattern = np.tanh(2 * smoothed(bumps.blotches, sensor, max(2, round(period_px)))) + pattern
    return np.asarray(np.clip(pattern, -1, 1), np.float32)


@cache
def noise_bank(height_px: int, width_px: int) -> Floats:
    """Float32 [2, 3, 3 height, 3 width] of unit normals and their negatives, the same in every process.

    A raw frame of that size adds a random crop. Drawing 400,000 normals per frame would cost more than the rest of the
    renderer; the 1.1 million crops and signs repeat too rarely to be learnt.
    """
    rng = np.random.Generator(np.random.PCG64(20_190_617))
    bank = rng.standard_normal((3, 3 * height_px, 3 * width_px), dtype=np.float32)
    both: Floats = np.stack([bank, -bank])
    both.setflags(write=False)
    return both
