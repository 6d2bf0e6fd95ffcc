"""Footprints and held surfaces of the objects.

Object frame: origin on the object's axis at grasp height, x across the gap, y along it (the fingers close along y), z
up. A footprint is a convex polygon [n, 2] in mm, counter-clockwise, of the object's flat bottom. A held profile is
the height y(x) of the surface that the fingers touch; the object is a prism there.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Shape = Literal["rectangle", "ellipse", "hexagon"]
Array = NDArray[np.float64]

CURVE_POINTS = 120  # a 120-gon errs by 0.009 mm on a 51 mm circle, far under any clearance


def footprint(shape: Shape, size_x_mm: float, size_y_mm: float, corner_radius_mm: float) -> Array:
    """Convex polygon [n, 2] in mm, counter-clockwise. Curves get tangent polygons of the right x extent."""
    if shape == "ellipse":
        angles = 2.0 * np.pi * np.arange(CURVE_POINTS) / CURVE_POINTS
        return np.stack([0.5 * size_x_mm * np.cos(angles), 0.5 * size_y_mm * np.sin(angles)], axis=1)
    if shape == "hexagon":
        angles = np.asarray(np.pi / 3.0 * np.arange(6))
        return np.asarray(0.5 * size_x_mm * np.stack([np.cos(angles), np.sin(angles)], axis=1))
    half: Array = np.array([0.5 * size_x_mm, 0.5 * size_y_mm])
    if corner_radius_mm <= 0.0:
        return np.asarray(np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]], dtype=np.float64) * half)
    arc: Array = np.linspace(0.0, 0.5 * np.pi, 9)
    corners = []
    for start, sign in ((0.0, (1, 1)), (0.5, (-1, 1)), (1.0, (-1, -1)), (1.5, (1, -1))):
        centre = (half - corner_radius_mm) * np.array(sign)
        turn = arc + np.pi * start
        corners.append(centre + corner_radius_mm * np.stack([np.cos(turn), np.sin(turn)], axis=1))
    return np.concatenate(corners)


def held_profile(shape: Shape, size_x_mm: float, size_y_mm: float, corner_radius_mm: float) -> Array:
    """Parameters (crest, flat half width, arc radius x, arc radius y, slope) in mm of the held surface, array [5].

    y(x) = crest for |x| within the flat part; beyond it an elliptic arc, or a plane of the given slope where slope > 0.
    """
    if shape == "ellipse":
        return np.array([0.5 * size_y_mm, 0.0, 0.5 * size_x_mm, 0.5 * size_y_mm, 0.0])
    if shape == "hexagon":
        return np.array([0.25 * math.sqrt(3.0) * size_x_mm, 0.25 * size_x_mm, 1.0, 1.0, math.sqrt(3.0)])
    radius = max(corner_radius_mm, 0.2)
    return np.array([0.5 * size_y_mm, 0.5 * size_x_mm - radius, radius, radius, 0.0])


def half_width_mm(polygon: Array, theta_deg: float) -> float:
    """Half the x extent in mm of a footprint [n, 2] yawed by theta_deg; it enters a gap G at |x| <= G/2 - this."""
    theta = math.radians(theta_deg)
    return float(np.max(polygon[:, 0] * math.cos(theta) - polygon[:, 1] * math.sin(theta)))
