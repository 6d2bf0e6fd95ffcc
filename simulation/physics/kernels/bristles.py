"""The two gel pads as grids of bristles: pressure from indentation, shear with Coulomb return mapping at each node.

Hand frame: origin at the TCP, x and z along the pads, the pads' undeformed surfaces at y = +-opening/2. A bristle
stands on its node and its tip keeps to the object's material until it slips, so that where nothing slips the end of a
motion does not depend on its load steps. The tip's stretch (mm, x and z) times kt is its traction, bounded by friction
times pressure; pressure is taken at the node and acts along the held surface's normal. One potential: 0.5 kn A d^2 for
indentation d > 0, and the Huber function of the trial stretch whose linear branch starts at the friction limit, so
that its gradient is exactly the return-mapped traction.
"""

import math
from typing import Any

import numpy as np
from numba import njit

from simulation.physics.kernels.linear import Vector
from simulation.physics.kernels.records import NODE, Records

FACE_FAR_MM = 1e6
STEEPEST = 0.95  # share of an arc's half width: it falls on straight beyond, as a cliff may leave no equilibrium
SLIP_MARGIN = 1e-7


def make_nodes(rows: int, columns: int, height_mm: float, width_mm: float, crown_mm: float) -> Records:
    """Nodes [2 * rows * columns] of both pads, v then u; finger 0 (side +1) sees u = +x, finger 1 -x, both v = -z."""
    u = (np.arange(columns) + 0.5) * width_mm / columns - 0.5 * width_mm
    v = (np.arange(rows) + 0.5) * height_mm / rows - 0.5 * height_mm
    vv, uu = (grid.ravel() for grid in np.meshgrid(v, u, indexing="ij"))
    nodes = np.zeros(2 * uu.size, dtype=NODE)
    nodes["side"] = np.repeat([1.0, -1.0], uu.size)
    nodes["x"], nodes["z"] = nodes["side"] * np.tile(uu, 2), -np.tile(vv, 2)
    reach = (nodes["x"] / (0.5 * width_mm)) ** 2 + (nodes["z"] / (0.5 * height_mm)) ** 2
    nodes["crown"], nodes["stiff"] = 0.5 * crown_mm * reach, 1.0
    return nodes


@njit(cache=True)
def surface(profile: Any, x: float) -> tuple[float, float]:
    """Height and slope of the held surface at x, mm."""
    beyond = abs(x) - profile[1]
    if beyond <= 0.0:
        return profile[0], 0.0
    sign = 1.0 if x > 0.0 else -1.0
    if profile[4] > 0.0:
        return profile[0] - profile[4] * beyond, -profile[4] * sign
    ratio = min(beyond / profile[2], STEEPEST)
    root = math.sqrt(1.0 - ratio * ratio)
    slope = profile[3] * ratio / (profile[2] * root)
    height = profile[0] - profile[3] * (1.0 - root)
    if ratio == STEEPEST:
        height -= slope * (beyond - STEEPEST * profile[2])
    return height, -sign * slope


@njit(cache=True)
def faceted(faces: Any, side: int, x: float) -> tuple[float, float]:
    """Height and slope of a polygon's held side (0: +y, 1: -y) at x, mm."""
    height, slope = faces[side, 0, 0] + faces[side, 0, 1] * x, faces[side, 0, 1]
    for k in range(1, faces.shape[1]):
        if faces[side, k, 0] >= FACE_FAR_MM:
            break
        at = faces[side, k, 0] + faces[side, k, 1] * x
        if at < height:
            height, slope = at, faces[side, k, 1]
    return height, slope


@njit(cache=True)
def indentation(constants: Any, node: Any, trial: Any) -> tuple[float, float]:
    """Indentation at a node, mm, and the held surface's slope there, for the object's trial pose in hand."""
    turn, place = trial.turn, trial.place
    dx, dy, dz = node.x - place[0], 0.5 * node.side * trial.opening - place[1], node.z - place[2]
    local_x = turn[0, 0] * dx + turn[1, 0] * dy + turn[2, 0] * dz
    local_y = turn[0, 1] * dx + turn[1, 1] * dy + turn[2, 1] * dz
    if constants.faceted:
        height, slope = faceted(constants.faces, 0 if node.side > 0 else 1, local_x)
    else:
        height, slope = surface(constants.profile, local_x)
    return height - node.side * local_y - node.crown, slope


@njit(cache=True)
def material(node: Any, trial: Any) -> Vector:
    """Where the object's material that was at a bristle's tip when the load step began is now, mm, hand frame."""
    x, y, z = node.x + node.sx, 0.5 * node.side * trial.opening, node.z + node.sz
    turn, step = trial.step_turn, trial.step
    return (
        turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z + step[0],
        turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z + step[1],
        turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z + step[2],
    )


@njit(cache=True)
def renew_limits(constants: Any, nodes: Any, trial: Any, blend: float) -> None:
    """Pressure at every node for the trial pose, and friction limits moved towards it by blend (1: all the way)."""
    for j in range(nodes.shape[0]):
        node = nodes[j]
        depth, _ = indentation(constants, node, trial)
        fresh = constants.kn * node.stiff * depth if depth > 0.0 else 0.0
        node.limit += blend * (constants.friction * fresh - node.limit)


@njit(cache=True)
def energy(constants: Any, nodes: Any, trial: Any) -> float:
    """Potential of both pads, N mm, friction limits held."""
    total = 0.0
    for j in range(nodes.shape[0]):
        node = nodes[j]
        depth, _ = indentation(constants, node, trial)
        if depth > 0.0:
            total += 0.5 * constants.kn * node.stiff * depth * depth
        if node.limit > 0.0:
            px, _, pz = material(node, trial)
            sx, sz = px - node.x, pz - node.z
            size = math.sqrt(sx * sx + sz * sz)
            bound = node.limit / constants.kt
            total += 0.5 * constants.kt * size * size if size <= bound else node.limit * (size - 0.5 * bound)
    return float(total * constants.area)


@njit(cache=True)
def _add_normal(node: Any, trial: Any, slope: float, k: float, depth: float, row: Any) -> None:
    """A node's normal spring k (N/mm) into gradient and lower Hessian; row [6] gets its line over the twist."""
    x, y, z = node.x, 0.5 * node.side * trial.opening, node.z
    turn, grad, hess = trial.turn, trial.grad, trial.hess
    for a in range(3):
        row[a] = node.side * turn[a, 1] - slope * turn[a, 0]
    row[3] = y * row[2] - z * row[1]
    row[4] = z * row[0] - x * row[2]
    row[5] = x * row[1] - y * row[0]
    for a in range(6):
        grad[a] += k * depth * row[a]
        scaled = k * row[a]
        for b in range(a + 1):
            hess[a, b] += scaled * row[b]


@njit(cache=True)
def _add_shear(hess: Any, kxx: float, kzz: float, kxz: float, px: float, py: float, pz: float) -> None:
    """Tangential stiffness at a point into the lower Hessian: lines x (1 0 0 0 pz -py) and z (0 0 1 py -px 0)."""
    mx, mz = kxx * pz - kxz * px, kxz * pz - kzz * px
    hess[0, 0] += kxx
    hess[2, 0] += kxz
    hess[2, 2] += kzz
    hess[3, 0] += kxz * py
    hess[3, 2] += kzz * py
    hess[3, 3] += kzz * py * py
    hess[4, 0] += mx
    hess[4, 2] += mz
    hess[4, 3] += mz * py
    hess[4, 4] += mx * pz - mz * px
    hess[5, 0] -= kxx * py
    hess[5, 2] -= kxz * py
    hess[5, 3] -= kxz * py * py
    hess[5, 4] -= mx * py
    hess[5, 5] += kxx * py * py


@njit(cache=True)
def _add_friction(constants: Any, node: Any, trial: Any, depth: float, coupled: bool, row: Any) -> None:
    """A node's bristle into gradient, lower Hessian and, where it slips under a following limit, skew."""
    grad, area = trial.grad, constants.area
    px, py, pz = material(node, trial)
    sx, sz = px - node.x, pz - node.z
    size = math.sqrt(sx * sx + sz * sz)
    slips = size * constants.kt > node.limit
    if slips:
        k, ux, uz = area * node.limit / size, sx / size, sz / size
        _add_shear(trial.hess, k * uz * uz, k * ux * ux, -k * ux * uz, px, py, pz)
    else:
        k = area * constants.kt
        _add_shear(trial.hess, k, k, 0.0, px, py, pz)
    fx, fz = k * sx, k * sz
    mx, my, mz = fz * py, fx * pz - fz * px, -fx * py
    grad[0] += fx
    grad[2] += fz
    grad[3] += mx
    grad[4] += my
    grad[5] += mz
    if slips and coupled:
        skew = trial.skew
        for b in range(6):
            follow = row[b] / depth
            skew[0, b] += fx * follow
            skew[2, b] += fz * follow
            skew[3, b] += mx * follow
            skew[4, b] += my * follow
            skew[5, b] += mz * follow


@njit(cache=True)
def assemble(constants: Any, nodes: Any, trial: Any, coupled: bool) -> None:
    """Add gradient and lower Hessian of `energy` to the trial's, for a twist about the TCP.

    coupled: limits follow the pressures (and are overwritten); their derivative, not symmetric, is added to skew.
    """
    row = np.empty(6)
    k = constants.kn * constants.area
    for j in range(nodes.shape[0]):
        node = nodes[j]
        depth, slope = indentation(constants, node, trial)
        if depth > 0.0:
            _add_normal(node, trial, slope, k * node.stiff, depth, row)
        if coupled:
            node.limit = constants.friction * constants.kn * node.stiff * max(depth, 0.0)
        if node.limit > 0.0:
            _add_friction(constants, node, trial, depth, coupled, row)


@njit(cache=True)
def settle(constants: Any, nodes: Any, trial: Any) -> tuple[int, float]:
    """Return-map the stretches at the end of a load step.

    Number of slipping nodes and the worst violation of the cone by the stretches that the forces were balanced with,
    N/mm2: what the return map is about to cut off.
    """
    slipping, worst = 0, 0.0
    for j in range(nodes.shape[0]):
        node = nodes[j]
        px, _, pz = material(node, trial)
        sx, sz = px - node.x, pz - node.z
        size = math.sqrt(sx * sx + sz * sz)
        depth, _ = indentation(constants, node, trial)
        node.pressure = constants.kn * node.stiff * max(depth, 0.0)
        worst = max(worst, min(constants.kt * size, node.limit) - constants.friction * node.pressure)
        bound = min(node.limit, constants.friction * node.pressure) / constants.kt
        share, node.slipped = 1.0, 0.0
        if size > bound:
            share = bound / size
            if bound > 0.0 and size > bound * (1.0 + SLIP_MARGIN):
                node.slipped = 1.0
                slipping += 1
        node.sx, node.sz = sx * share, sz * share
    return slipping, worst
