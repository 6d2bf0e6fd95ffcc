"""From bristles to the camera's view: displacement and pressure of each gel at the marker rest positions.

A pad's rubber couples neighbours over about half its thickness and, being incompressible, bulges away from pressure.
The bristles model neither, so the readout adds both (`gel_coupling`). It changes no force.
"""

import numpy as np
from numpy.typing import NDArray

from simulation.physics.pads import Pad
from simulation.scene.scene import Scene

Array = NDArray[np.floating]

COUPLING_PER_THICKNESS = 0.5
BULGE = (
    0.25  # a bonded incompressible layer sheared by dp/dx moves by h^2 / (2 G) dp/dx if free; half of it under friction
)


def _blend(targets: Array, nodes: Array, sigma_mm: float) -> Array:
    """Rows of weights [targets, nodes] that interpolate linearly and, for sigma > 0, blur by a Gaussian."""
    pitch = nodes[1] - nodes[0]
    distance = np.abs(targets[:, None] - nodes[None, :])
    linear = np.clip(1.0 - distance / pitch, 0.0, None)
    if targets.size == nodes.size and sigma_mm <= 0.0 and np.allclose(targets, nodes):
        return np.asarray(linear)
    if sigma_mm > 0.0:
        linear = np.exp(-0.5 * (distance / max(sigma_mm, 0.5 * pitch)) ** 2)
        # beyond the pad the gel is at rest, so normalise by the kernel's full mass, not by its part on the pad
        return np.asarray(linear / (np.sqrt(2.0 * np.pi) * max(sigma_mm, 0.5 * pitch) / pitch))
    return np.asarray(linear / np.sum(linear, axis=1, keepdims=True))


def _nearest(targets: Array, nodes: Array) -> NDArray[np.intp]:
    return np.asarray(np.argmin(np.abs(targets[:, None] - nodes[None, :]), axis=1))


class Readout:
    """Gel fields of a scene: call with stretch [n, 2] mm and pressure [n]; gives float32 [2, rows, columns, 3]."""

    def __init__(self, scene: Scene, pad: Pad, *, coupled: bool) -> None:
        gel, sensor = scene.gel, scene.sensor
        pitch, (margin_u, margin_v) = sensor.marker_pitch_mm, sensor.gel_margin_mm
        self.rows, self.columns = gel.node_rows, gel.node_columns
        v = (np.arange(sensor.marker_rows) + margin_v / pitch) * pitch - 0.5 * sensor.gel_height_mm
        u = (np.arange(sensor.marker_columns) + margin_u / pitch) * pitch - 0.5 * sensor.gel_width_mm
        height, width = pad.height_mm, pad.width_mm
        node_v = (np.arange(self.rows) + 0.5) * height / self.rows - 0.5 * height
        node_u = (np.arange(self.columns) + 0.5) * width / self.columns - 0.5 * width
        sigma = COUPLING_PER_THICKNESS * gel.thickness_mm if coupled else 0.0
        self.along_v, self.along_u = _blend(v, node_v, sigma), _blend(u, node_u, sigma)
        self.sharp_v, self.sharp_u = _blend(v, node_v, 0.0), _blend(u, node_u, 0.0)
        self.bulge = BULGE * gel.thickness_mm**2 / gel.shear_modulus_n_per_mm2 if coupled else 0.0
        self.pitch = pitch
        self._nearest = np.ix_(np.arange(2), _nearest(v, node_v), _nearest(u, node_u))

    def at_markers(self, values: Array) -> Array:
        """Values [n] at the nodes, taken from the node nearest each marker: [2, rows, columns]."""
        return values.reshape(2, self.rows, self.columns)[self._nearest]

    def __call__(self, stretch: Array, pressure: Array) -> NDArray[np.float32]:
        out = np.empty((2, self.along_v.shape[0], self.along_u.shape[0], 3), dtype=np.float32)
        count = self.rows * self.columns
        for finger in range(2):
            part = slice(finger * count, (finger + 1) * count)
            sign = 1.0 if finger == 0 else -1.0
            grid = (self.rows, self.columns)
            du = self.along_v @ (sign * stretch[part, 0].reshape(grid)) @ self.along_u.T
            dv = self.along_v @ (-stretch[part, 1].reshape(grid)) @ self.along_u.T
            field = pressure[part].reshape(grid)
            if self.bulge > 0.0:
                push_u, push_v = self._bulged(field)
                du, dv = du - push_u, dv - push_v
            out[finger, ..., 0], out[finger, ..., 1] = du, dv
            out[finger, ..., 2] = self.sharp_v @ field @ self.sharp_u.T
        return out

    def _bulged(self, field: Array) -> tuple[Array, Array]:
        """Displacement of the markers up the slope of a pad's pressure [rows, columns], mm along u and v."""
        soft = self.along_v @ field @ self.along_u.T
        slope_v, slope_u = np.gradient(soft, self.pitch)
        return np.asarray(self.bulge * slope_u), np.asarray(self.bulge * slope_v)
