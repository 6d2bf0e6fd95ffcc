"""Footprints and held surfaces of the objects.

Object frame: origin on the object's axis at grasp height, x across the gap, y along it (the fingers close along y), z
up. A footprint is a convex polygon [n, 2] in mm, counter-clockwise, of the object's flat bottom. A held profile is
the height y(x) of the surface that the fingers touch; the object is a prism there.
"""

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Shape = Literal["rectangle", "ellipse", "hexagon"]
Outline = Literal["rectangle", "ellipse", "hexagon", "polygon"]
Array = NDArray[np.float64]
Vertices = Sequence[tuple[float, float]] | Array

MOST_EDGES = 64  # of a polygon with its corners rounded
MAX_FACES = MOST_EDGES + 2  # of one held side of a polygon: its edges and a wall at either end
WALL_SLOPE = 5.0  # an upright wall would have infinite slope
GRIP_HALF_MM = 10.0  # about half of a gel's width: the part by which the fingers centre an object
FAR_MM = 1e6
CURVE_POINTS = 120  # a 120-gon errs by 0.009 mm on a 51 mm circle, far under any clearance


def footprint(shape: Outline, size_x_mm: float, size_y_mm: float, corner_radius_mm: float) -> Array:
    """Convex polygon [n, 2] in mm, counter-clockwise. Curves get tangent polygons of the right x extent."""
    if shape == "ellipse":
        angles = 2.0 * np.pi * np.arange(CURVE_POINTS) / CURVE_POINTS
        return np.stack([0.5 * size_x_mm * np.cos(angles), 0.5 * size_y_mm * np.sin(angles)], axis=1)
    if shape == "hexagon":
        return rounded(_hexagon(size_x_mm, size_y_mm), corner_radius_mm)
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


def held_profile(shape: Outline, size_x_mm: float, size_y_mm: float, corner_radius_mm: float) -> Array:
    """Parameters (crest, flat half width, arc radius x, arc radius y, slope) in mm of the held surface, array [5].

    y(x) = crest for |x| within the flat part; beyond it an elliptic arc, or a plane of the given slope where slope > 0.
    """
    if shape == "ellipse":
        return np.array([0.5 * size_y_mm, 0.0, 0.5 * size_x_mm, 0.5 * size_y_mm, 0.0])
    if shape == "hexagon":
        stretch = _stretch(size_x_mm, size_y_mm)
        crest_mm = 0.25 * math.sqrt(3.0) * size_x_mm * stretch
        return np.array([crest_mm, 0.25 * size_x_mm, 1.0, 1.0, math.sqrt(3.0) * stretch])
    radius = max(corner_radius_mm, 0.2)
    return np.array([0.5 * size_y_mm, 0.5 * size_x_mm - radius, radius, radius, 0.0])


def _hexagon(size_x_mm: float, size_y_mm: float) -> Array:
    angles = np.asarray(np.pi / 3.0 * np.arange(6))
    corners = 0.5 * size_x_mm * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return np.asarray(corners * (1.0, _stretch(size_x_mm, size_y_mm)))


def _stretch(size_x_mm: float, size_y_mm: float) -> float:
    """Height of a hexagon over that of a regular one, which equal sizes stand for: its corners lie on a circle."""
    return 1.0 if size_x_mm == size_y_mm else size_y_mm / (math.sqrt(0.75) * size_x_mm)


def held_polygon(shape: Outline, size_x_mm: float, size_y_mm: float, corner_radius_mm: float) -> Array | None:
    """The section between the fingers [n, 2], mm, for shapes whose edges alone define it: a hexagon with radii."""
    if shape != "hexagon" or corner_radius_mm <= 0.0:
        return None
    return rounded(_hexagon(size_x_mm, size_y_mm), corner_radius_mm)


def rounded(vertices: Vertices, radius_mm: float) -> Array:
    """A convex polygon [n, 2] with an arc in place of each corner, as tangent edges; all within `MOST_EDGES`.

    Raises ValueError where two arcs do not fit on the edge between them.
    """
    corners: Array = np.asarray(vertices, np.float64)
    if radius_mm <= 0.0:
        return corners
    before, after = corners - np.roll(corners, 1, axis=0), np.roll(corners, -1, axis=0) - corners
    turn = np.arctan2(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0], (before * after).sum(axis=1))
    cut = radius_mm * np.tan(0.5 * turn)
    room = np.linalg.norm(after, axis=1) - cut - np.roll(cut, -1)
    if room.min() < 0.0:
        raise ValueError("object.corner_radius_mm: two corners' arcs do not fit on the edge between them")
    pieces = int(np.clip(MOST_EDGES // len(corners) - 1, 1, 8))
    shares = np.arange(pieces) + 0.5  # the corners of a tangent polygon: half a piece beyond the start of the arc
    ahead = np.arctan2(before[:, 1], before[:, 0])[:, None] + turn[:, None] / pieces * shares
    centre = corners - (cut / np.linalg.norm(before, axis=1))[:, None] * before
    centre = centre + radius_mm * np.stack([-before[:, 1], before[:, 0]], 1) / np.linalg.norm(before, axis=1)[:, None]
    out = radius_mm / np.cos(0.5 * turn / pieces)[:, None]
    points = np.stack([np.sin(ahead), -np.cos(ahead)], axis=-1) * out[..., None] + centre[:, None]
    return np.asarray(points.reshape(-1, 2))


def centred(vertices: Vertices) -> Array:
    """A polygon's vertices [n, 2], mm, moved to the position in which the fingers hold it.

    The middle of its extent across the gap is at x = 0, and both fingers touch it equally far from y = 0.
    """
    polygon: Array = np.asarray(vertices, np.float64)
    polygon = polygon - [0.5 * (polygon[:, 0].max() + polygon[:, 0].min()), 0.0]
    crests = np.array([_height(lines, polygon).max() for lines in _sides(polygon)])
    return np.asarray(polygon - [0.0, 0.5 * (crests[0] - crests[1])])


def crest_mm(vertices: Vertices) -> float:
    """Distance from y = 0 at which either finger touches a polygon that it holds."""
    polygon = centred(vertices)
    return float(_height(_sides(polygon)[0], polygon).max())


def faces(vertices: Vertices) -> Array:
    """Held sides (+y, -y) of a polygon, [2, MAX_FACES, 2]: lines (height at x = 0 in mm, slope), the lowest counts."""
    lines: Array = np.zeros((2, MAX_FACES, 2))
    lines[..., 0] = FAR_MM
    for side, edges in zip(lines, _sides(centred(vertices)), strict=True):
        side[: len(edges)] = edges
    return lines


def _sides(polygon: Array) -> list[Array]:
    """Lines [k, 2] of both sides of a convex polygon: its edges there and a steep wall at either end."""
    ahead = np.roll(polygon, -1, axis=0)
    return [_side(polygon, ahead), _side(-polygon, -ahead) * (1.0, -1.0)]


def _side(start: Array, end: Array) -> Array:
    upper = start[:, 0] - end[:, 0] > 1e-9
    slope = (end - start)[upper, 1] / (end - start)[upper, 0]
    (right, top_right), (left, top_left) = start[upper][start[upper, 0].argmax()], end[upper][end[upper, 0].argmin()]
    down, up = min(-WALL_SLOPE, slope.min()), max(WALL_SLOPE, slope.max())
    edges = np.stack([start[upper, 1] - slope * start[upper, 0], slope], axis=1)
    return np.concatenate([edges, [(top_right - down * right, down), (top_left - up * left, up)]])


def _height(lines: Array, polygon: Array) -> Array:
    """Height of a held side at every place where it can be highest between the fingers."""
    x = np.concatenate([polygon[np.abs(polygon[:, 0]) < GRIP_HALF_MM, 0], [-GRIP_HALF_MM, GRIP_HALF_MM]])
    return np.asarray((lines[:, 0] + np.multiply.outer(x, lines[:, 1])).min(axis=1))


def is_convex(vertices: Vertices) -> bool:
    """Whether the vertices go once around a convex polygon, counter-clockwise, with no corner of 180 deg."""
    polygon: Array = np.asarray(vertices, np.float64)
    edges = np.roll(polygon, -1, axis=0) - polygon
    ahead = np.roll(edges, -1, axis=0)
    turns = np.arctan2(edges[:, 0] * ahead[:, 1] - edges[:, 1] * ahead[:, 0], (edges * ahead).sum(axis=1))
    return bool((turns > 1e-9).all() and abs(turns.sum() - 2.0 * np.pi) < 1e-6)


def half_width_mm(polygon: Array, theta_deg: float) -> float:
    """Half the x extent in mm of a footprint [n, 2] yawed by theta_deg; it enters a gap G at |x| <= G/2 - this."""
    theta = math.radians(theta_deg)
    return float(np.max(polygon[:, 0] * math.cos(theta) - polygon[:, 1] * math.sin(theta)))
