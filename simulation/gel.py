"""The two gel pads as grids of bristles: pressure from indentation, shear with Coulomb return mapping at each node.

Hand frame: origin at the TCP, x and z along the pads, the pads' undeformed surfaces at y = +-opening/2. Nodes never
move in the pad; the object's material moves past them. A node's stretch (mm, x and z) times kt is its traction,
bounded by friction times pressure. One potential: 0.5 kn A d^2 for indentation d > 0, and the Huber function of the
trial stretch whose linear branch starts at the friction limit, so that its gradient is exactly the return-mapped
traction.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

FAR_MM = 1e3


class Pads(NamedTuple):
    """Both pads' nodes: place (x, side, z) [n, 3], crown recess [n], profile [5], then area, kn, kt, friction."""

    node: Array
    crown_mm: Array
    profile: Array
    area_mm2: float
    kn: float
    kt: float
    friction: float


def make_pads(
    profile: Array,
    rows: int,
    columns: int,
    height_mm: float,
    width_mm: float,
    crown_mm: float,
    kt: float,
    normal_ratio: float,
    friction: float,
) -> Pads:
    """Lay out nodes [2 * rows * columns]; finger 0 (side +1) sees u = +x, finger 1 (side -1) u = -x, both v = -z."""
    u = (np.arange(columns) + 0.5) * width_mm / columns - 0.5 * width_mm
    v = (np.arange(rows) + 0.5) * height_mm / rows - 0.5 * height_mm
    vv, uu = np.meshgrid(v, u, indexing="ij")
    one = [np.stack([side * uu.ravel(), np.full(uu.size, side), -vv.ravel()], axis=1) for side in (1.0, -1.0)]
    reach = (uu / (0.5 * width_mm)) ** 2 + (vv / (0.5 * height_mm)) ** 2
    crown = np.tile(0.5 * crown_mm * reach.ravel(), 2)
    area = width_mm * height_mm / (rows * columns)
    return Pads(np.ascontiguousarray(np.concatenate(one)), crown, profile, area, kt * normal_ratio, kt, friction)


@njit(cache=True)
def surface(profile: Array, x: float) -> tuple[float, float]:
    """Height and slope of the held surface at x, mm; -FAR_MM where there is none."""
    beyond = abs(x) - profile[1]
    if beyond <= 0.0:
        return profile[0], 0.0
    sign = 1.0 if x > 0.0 else -1.0
    if profile[4] > 0.0:
        return profile[0] - profile[4] * beyond, -profile[4] * sign
    ratio = beyond / profile[2]
    if ratio >= 0.95:
        return -FAR_MM, 0.0
    root = math.sqrt(1.0 - ratio * ratio)
    return profile[0] - profile[3] * (1.0 - root), -sign * profile[3] * ratio / (profile[2] * root)


@njit(cache=True)
def indentation(pads: Pads, j: int, opening: float, turn: Array, place: Array) -> tuple[float, float]:
    """Indentation of node j, mm, and the held surface's slope there, for the object's pose in hand."""
    side = pads.node[j, 1]
    dx = pads.node[j, 0] - place[0]
    dy = 0.5 * side * opening - place[1]
    dz = pads.node[j, 2] - place[2]
    local_x = turn[0, 0] * dx + turn[1, 0] * dy + turn[2, 0] * dz
    local_y = turn[0, 1] * dx + turn[1, 1] * dy + turn[2, 1] * dz
    height, slope = surface(pads.profile, local_x)
    return height - side * local_y - pads.crown_mm[j], slope


@njit(cache=True)
def pressures(pads: Pads, opening: float, turn: Array, place: Array, out: Array) -> None:
    """Pressure at every node, N/mm2, into out [n]."""
    for j in range(out.shape[0]):
        depth, _ = indentation(pads, j, opening, turn, place)
        out[j] = pads.kn * depth if depth > 0.0 else 0.0


@njit(cache=True)
def energy(
    pads: Pads, opening: float, turn: Array, place: Array, step_turn: Array, step: Array, stretch: Array, limit: Array
) -> float:
    """Potential of both pads, N mm. step_turn, step: motion since the load step began.

    Limit [n]: traction bound, N/mm2.
    """
    total = 0.0
    for j in range(limit.shape[0]):
        depth, _ = indentation(pads, j, opening, turn, place)
        if depth > 0.0:
            total += 0.5 * pads.kn * depth * depth
        if limit[j] > 0.0:
            x, y, z = pads.node[j, 0], 0.5 * pads.node[j, 1] * opening, pads.node[j, 2]
            sx = stretch[j, 0] + step_turn[0, 0] * x + step_turn[0, 1] * y + step_turn[0, 2] * z + step[0] - x
            sz = stretch[j, 1] + step_turn[2, 0] * x + step_turn[2, 1] * y + step_turn[2, 2] * z + step[2] - z
            size = math.sqrt(sx * sx + sz * sz)
            bound = limit[j] / pads.kt
            total += 0.5 * pads.kt * size * size if size <= bound else limit[j] * (size - 0.5 * bound)
    return total * pads.area_mm2


@njit(cache=True)
def _add_row(grad: Array, hess: Array, row: Array, force: float, stiffness: float) -> None:
    for a in range(6):
        grad[a] += force * row[a]
        scaled = stiffness * row[a]
        for b in range(a + 1):
            hess[a, b] += scaled * row[b]


@njit(cache=True)
def assemble(
    pads: Pads,
    opening: float,
    turn: Array,
    place: Array,
    step_turn: Array,
    step: Array,
    stretch: Array,
    limit: Array,
    grad: Array,
    hess: Array,
) -> None:
    """Add gradient [>= 6] and lower half of the Hessian of `energy` for a twist about the TCP (mm, rad)."""
    row = np.empty(6)
    g, h = np.zeros(6), np.zeros((6, 6))
    for j in range(limit.shape[0]):
        side = pads.node[j, 1]
        x, y, z = pads.node[j, 0], 0.5 * side * opening, pads.node[j, 2]
        depth, slope = indentation(pads, j, opening, turn, place)
        if depth > 0.0:
            for a in range(3):
                row[a] = side * turn[a, 1] - slope * turn[a, 0]
            row[3] = y * row[2] - z * row[1]
            row[4] = z * row[0] - x * row[2]
            row[5] = x * row[1] - y * row[0]
            _add_row(g, h, row, pads.kn * depth, pads.kn)
        if limit[j] > 0.0:
            px = step_turn[0, 0] * x + step_turn[0, 1] * y + step_turn[0, 2] * z + step[0]
            py = step_turn[1, 0] * x + step_turn[1, 1] * y + step_turn[1, 2] * z + step[1]
            pz = step_turn[2, 0] * x + step_turn[2, 1] * y + step_turn[2, 2] * z + step[2]
            sx, sz = stretch[j, 0] + px - x, stretch[j, 1] + pz - z
            size = math.sqrt(sx * sx + sz * sz)
            kxx, kzz, kxz, share = pads.kt, pads.kt, 0.0, 1.0
            if size * pads.kt > limit[j]:
                share = limit[j] / (pads.kt * size)
                ux, uz = sx / size, sz / size
                kxx, kzz, kxz = pads.kt * share * uz * uz, pads.kt * share * ux * ux, -pads.kt * share * ux * uz
            fx, fz = pads.kt * share * sx, pads.kt * share * sz
            # rows of the twist: x: (1, 0, 0, 0, pz, -py); z: (0, 0, 1, py, -px, 0)
            g[0] += fx
            g[2] += fz
            g[3] += fz * py
            g[4] += fx * pz - fz * px
            g[5] -= fx * py
            mx, mz = kxx * pz - kxz * px, kxz * pz - kzz * px
            h[0, 0] += kxx
            h[2, 0] += kxz
            h[2, 2] += kzz
            h[3, 0] += kxz * py
            h[3, 2] += kzz * py
            h[3, 3] += kzz * py * py
            h[4, 0] += mx
            h[4, 2] += mz
            h[4, 3] += mz * py
            h[4, 4] += mx * pz - mz * px
            h[5, 0] -= kxx * py
            h[5, 2] -= kxz * py
            h[5, 3] -= kxz * py * py
            h[5, 4] -= mx * py
            h[5, 5] += kxx * py * py
    for a in range(6):
        grad[a] += pads.area_mm2 * g[a]
        for b in range(a + 1):
            hess[a, b] += pads.area_mm2 * h[a, b]


@njit(cache=True)
def settle(
    pads: Pads, opening: float, step_turn: Array, step: Array, limit: Array, stretch: Array, slipped: Ints
) -> int:
    """Return-map the stretches in place at the end of a load step; gives the number of slipping nodes."""
    slipping = 0
    for j in range(limit.shape[0]):
        x, y, z = pads.node[j, 0], 0.5 * pads.node[j, 1] * opening, pads.node[j, 2]
        sx = stretch[j, 0] + step_turn[0, 0] * x + step_turn[0, 1] * y + step_turn[0, 2] * z + step[0] - x
        sz = stretch[j, 1] + step_turn[2, 0] * x + step_turn[2, 1] * y + step_turn[2, 2] * z + step[2] - z
        size = math.sqrt(sx * sx + sz * sz)
        bound = limit[j] / pads.kt
        share = 1.0
        slipped[j] = 0
        if size > bound:
            share = bound / size
            if bound > 0.0 and size > bound * (1.0 + 1e-7):
                slipped[j] = 1
                slipping += 1
        stretch[j, 0], stretch[j, 1] = sx * share, sz * share
    return slipping
