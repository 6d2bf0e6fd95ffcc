"""The held surface: its height and slope on both sides of an object.

Object frame. On side s (+1: +y, -1: -y) the surface is y = s * height(x); the object is a prism there.
"""

import numpy as np
from numpy.typing import NDArray

from simulation.scene.parts import HeldObject

Array = NDArray[np.float64]

STEEPEST = 0.95  # share of an arc's half width: it falls on straight beyond, as a cliff may leave no equilibrium


class HeldSurface:
    """Both sides of an object between the fingers."""

    def __init__(self, body: HeldObject) -> None:
        self._profile, self._faces = body.held_profile, body.held_faces

    @property
    def crest_mm(self) -> float:
        """Largest distance from y = 0 that the object reaches between the fingers."""
        return float(self._profile[0])

    def at(self, side: Array, x: Array) -> tuple[Array, Array]:
        """Height, mm, and slope of the side (+1, -1) [n] at x [n], mm."""
        return self._arched(x) if self._faces is None else self._faceted(side, x)

    def _faceted(self, side: Array, x: Array) -> tuple[Array, Array]:
        assert self._faces is not None
        lines = self._faces[np.where(side > 0.0, 0, 1)]
        heights = lines[..., 0] + lines[..., 1] * x[:, None]
        lowest = heights.argmin(axis=1)
        each = np.arange(len(x))
        return heights[each, lowest], lines[each, lowest, 1]

    def _arched(self, x: Array) -> tuple[Array, Array]:
        crest, flat, radius_x, radius_y, incline = self._profile
        beyond = np.maximum(np.abs(x) - flat, 0.0)
        if incline > 0.0:
            return crest - incline * beyond, np.where(beyond > 0.0, -incline * np.sign(x), 0.0)
        share = np.minimum(beyond / radius_x, STEEPEST)
        root = np.sqrt(1.0 - share**2)
        slope = radius_y * share / (radius_x * root)
        height = crest - radius_y * (1.0 - root) - slope * np.maximum(beyond - STEEPEST * radius_x, 0.0)
        return height, -np.sign(x) * slope
