"""A short film of an insertion in the simulated cell: what both gels did, and the object's true pose."""

import threading
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from service.contract import Sensor
from simulation.cell.world import Exposure, World

RATE_HZ, MOST_N = 10.0, 1200
HIGH, WIDE, SIDE_MM = 300, 300, 90.0
ARROWS = 6.0  # arrows are drawn this many times longer than the motion
GROUND, QUIET, STICKS, BLOCK, OBJECT, TEXT = (
    (24, 19, 14),
    (96, 84, 72),
    (192, 198, 53),
    (79, 66, 54),
    (255, 184, 127),
    (247, 243, 238),
)
Image = NDArray[np.uint8]


class Course:
    """Collects ten moments per second on the world's thread, from the first moment in which something is held."""

    def __init__(self, world: World, fps: float) -> None:
        self._world = world
        self._every = max(1, round(fps / RATE_HZ))
        self._moments: list[tuple[NDArray[np.float16], tuple[float, float, float]]] = []
        self._lock = threading.Lock()

    def __call__(self, exposure: Exposure) -> None:
        state = self._world.state
        if exposure.seq % self._every or state is None or not self._world.held or len(self._moments) >= MOST_N:
            return
        x_mm, theta_deg = state.object_error
        with self._lock:
            self._moments.append(
                (np.asarray(exposure.gel, np.float16), (float(x_mm), float(theta_deg), float(state.bottom_z_mm)))
            )

    def save(self, path: Path, gap_mm: float) -> None:
        """Write the moments as an ``.npz``; without any, no file."""
        with self._lock:
            gels, places = [gel for gel, _ in self._moments], [place for _, place in self._moments]
        if gels:
            np.savez_compressed(path, gel=np.stack(gels), place=np.array(places, np.float32), gap_mm=gap_mm)


def draw(course: Path, path: Path, sensor: Sensor) -> Path | None:
    """An animated GIF of a saved course: arrows of both gels, and the object next to the gap; None without a course."""
    from PIL import Image as Pillow

    if not course.is_file():
        return None
    with np.load(course) as saved:
        gels, places, gap_mm = saved["gel"].astype(np.float32), saved["place"], float(saved["gap_mm"])
    first = gels[0]
    pictures = [
        Pillow.fromarray(_picture(gel - first, place, gap_mm, sensor)[..., ::-1]).quantize(32)
        for gel, place in zip(gels, places, strict=True)
    ]
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=round(1e3 / RATE_HZ), loop=0)
    return path


def _picture(moved: NDArray[Any], place: NDArray[Any], gap_mm: float, sensor: Sensor) -> Image:
    fingers = [_gel(moved[k], sensor, name) for k, name in enumerate(("left finger", "right finger"))]
    return np.hstack([*fingers, _side(place, gap_mm)])


def _gel(moved: NDArray[Any], sensor: Sensor, name: str) -> Image:
    """Arrows of one gel's motion since the grasp, mm to the scale of the picture."""
    picture = np.full((HIGH, WIDE, 3), GROUND, np.uint8)
    scale = min(WIDE / sensor.width_px, (HIGH - 24) / sensor.height_px)
    rest = sensor.marker_rest_px().reshape(-1, 2) * scale
    step = moved[..., :2].reshape(-1, 2) / sensor.mm_per_px * scale * ARROWS
    for start, end, pressed in zip(rest, rest + step, moved[..., 2].ravel(), strict=True):
        colour = STICKS if np.hypot(*(end - start)) > 3.0 or pressed > 0 else QUIET
        cv2.line(picture, _px(start), _px(end), colour, 1, cv2.LINE_AA)
        cv2.circle(picture, _px(start), 1, QUIET, -1, cv2.LINE_AA)
    return _captioned(picture, name)


def _side(place: NDArray[Any], gap_mm: float) -> Image:
    """The object from the side, with its true offset, depth and yaw."""
    picture = np.full((HIGH, WIDE, 3), GROUND, np.uint8)
    scale, top = WIDE / SIDE_MM, 0.62 * HIGH
    x_mm, theta_deg, bottom_mm = (float(value) for value in place)

    def at(x: float, z: float) -> tuple[int, int]:
        return round(WIDE / 2 + scale * x), round(top - scale * z)

    for side in (-1, 1):
        inner, outer = side * gap_mm / 2, side * SIDE_MM / 2
        cv2.rectangle(picture, at(min(inner, outer), 0.0), at(max(inner, outer), -40.0), BLOCK, -1)
    half = gap_mm / 2 - 2.0
    cv2.rectangle(picture, at(x_mm - half, bottom_mm + 40.0), at(x_mm + half, bottom_mm), OBJECT, 2, cv2.LINE_AA)
    return _captioned(picture, f"x {x_mm:+.1f} mm, yaw {theta_deg:+.1f} deg, {max(0.0, -bottom_mm):.1f} mm deep")


def _captioned(picture: Image, text: str) -> Image:
    cv2.putText(picture, text, (8, HIGH - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.42, TEXT, 1, cv2.LINE_AA)
    return picture


def _px(point: NDArray[Any]) -> tuple[int, int]:
    return round(float(point[0])), round(float(point[1]))
