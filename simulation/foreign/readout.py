"""From the pads' face to the camera's view: displacement, pressure and imprint at the marker rest positions."""

import numpy as np
from numpy.typing import NDArray

from service.contract import Sensor
from simulation.foreign.elements import Face

Array = NDArray[np.float64]


class Readout:
    """Gel fields of a sensor: nodes' displacements and pressures in, float32 [2, rows, columns, 4] out.

    The fourth value is the depth of the imprint, mm, for this cell's own pictures.
    """

    def __init__(self, face: Face, sensor: Sensor) -> None:
        pitch, (margin_u, margin_v) = sensor.marker_pitch_mm, sensor.gel_margin_mm
        u: Array = np.linspace(0.0, pitch * (sensor.marker_columns - 1), sensor.marker_columns)
        v: Array = np.linspace(0.0, pitch * (sensor.marker_rows - 1), sensor.marker_rows)
        u, v = u + (margin_u - 0.5 * sensor.gel_width_mm), v + (margin_v - 0.5 * sensor.gel_height_mm)
        # finger 0 sees x to its right, finger 1 to its left; both see z upwards, v runs down
        self._curved = [(_quadratic(face.z, -v), _quadratic(face.x, side * u)) for side in (1.0, -1.0)]
        self._straight = [(_linear(face.z, -v), _linear(face.x, side * u)) for side in (1.0, -1.0)]
        self._nearest = [
            np.ix_(np.abs(-v[:, None] - face.z).argmin(1), np.abs(s * u[:, None] - face.x).argmin(1))
            for s in (1.0, -1.0)
        ]
        self._grid = (len(face.z), len(face.x))

    def __call__(self, motion: Array, pressure: Array) -> NDArray[np.float32]:
        """Motion [n, 3], mm, hand frame, and pressure [n], N/mm2, of both pads' nodes."""
        fingers = []
        for finger, side in enumerate((1.0, -1.0)):
            along_v, along_u = self._curved[finger]
            moved = motion.reshape(2, *self._grid, 3)[finger]
            du, dv = side * along_v @ moved[..., 0] @ along_u.T, -along_v @ moved[..., 2] @ along_u.T
            pressed_in = side * along_v @ moved[..., 1] @ along_u.T
            along_v, along_u = self._straight[finger]
            pressed = along_v @ pressure.reshape(2, *self._grid)[finger] @ along_u.T
            fingers.append(np.stack([du, dv, pressed, pressed_in], axis=-1))
        return np.asarray(fingers, np.float32)

    def nearest(self, values: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Values of the nodes [n] nearest each marker: [2, rows, columns]."""
        grids = values.reshape(2, *self._grid)
        return np.stack([grid[index] for grid, index in zip(grids, self._nearest, strict=True)])


def _quadratic(lines: Array, at: Array) -> Array:
    """Weights [at, lines] of the elements' own quadratic interpolation; every second line is an element's border."""
    element = np.clip(np.searchsorted(lines[::2], at, side="right") - 1, 0, len(lines) // 2 - 1)
    low, high = lines[2 * element], lines[2 * element + 2]
    t = 2.0 * (at - low) / (high - low) - 1.0
    out, row = np.zeros((len(at), len(lines))), np.arange(len(at))
    for step, weight in enumerate((0.5 * t * (t - 1.0), 1.0 - t * t, 0.5 * t * (t + 1.0))):
        out[row, 2 * element + step] = weight
    return out


def _linear(lines: Array, at: Array) -> Array:
    """Weights [at, lines] of linear interpolation, which keeps pressures positive."""
    return np.stack([np.interp(at, lines, unit) for unit in np.eye(len(lines))], axis=1)
