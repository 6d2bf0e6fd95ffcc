"""Where the object's prism meets the two blocks: exact clipping of the footprint against edge, top and wall.

Block frame: origin on the inner top edge, x into the block, z up, so that both blocks run the same code. A contact is
a slot (block, index) that keeps its friction memory from step to step: slots 0 and 1 are the two ends of the block's
edge under the footprint, then one per footprint vertex (on the top face, or against the wall below it), then one per
vertical edge of the prism where it passes the block's top edge. Block 0 is at +x, block 1 at -x.
"""

import math
from typing import Any

from numba import njit

from simulation.physics.kernels.linear import Vector, apply, apply_t, product_into

TOP, WALL = 0, 1
EDGE, FACE, SIDE = 0, 1, 2
NEAR_MM = 1.0
SHARED_STIFFNESS = 8.0  # a curved footprint's many vertices share the stiffness of this many


@njit(cache=True)
def locate(work: Any, b: int) -> None:
    """Footprint vertices, at the object's pose in the world, in block b's frame: into corner [v, 3]."""
    trial, foot, corner, bottom = work.trials[0], work.foot, work.corner, work.constants[0].bottom
    frame, origin = trial.block_turn[b], trial.block[b]
    for k in range(foot.shape[0]):
        x, y, z = apply(trial.world_turn, foot[k, 0], foot[k, 1], bottom)
        x, y, z = x + trial.world[0] - origin[0], y + trial.world[1] - origin[1], z + trial.world[2] - origin[2]
        corner[k, 0], corner[k, 1], corner[k, 2] = apply_t(frame, x, y, z)


@njit(cache=True)
def update_mode(corner: Any, mode: int) -> int:
    """Top or wall contact, with memory: a footprint must clear the block to enter, and rise above its top to leave."""
    overlap, lowest, depth = -1e9, 1e9, 0.0
    for k in range(corner.shape[0]):
        overlap, lowest = max(overlap, corner[k, 0]), min(lowest, corner[k, 2])
        if corner[k, 0] > 0.0:
            depth = max(depth, -corner[k, 2])
    if mode == TOP and lowest < 0.0 and (overlap <= 0.0 or depth > overlap + 0.5):
        return WALL
    if mode == WALL and lowest >= 0.0:
        return TOP
    return mode


@njit(cache=True)
def _fill(row: Any, trial: Any, k: int, n: int, b: int, direction: Vector, point: Vector) -> None:
    """Line k of a row: how the object's point (against the block's) moves along a world direction."""
    dx, dy, dz = apply_t(trial.hand, direction[0], direction[1], direction[2])
    tcp, origin, line = trial.tcp, trial.block[b], row.line
    rx, ry, rz = apply_t(trial.hand, point[0] - tcp[0], point[1] - tcp[1], point[2] - tcp[2])
    for a in range(n):
        line[k, a] = 0.0
    line[k, 0], line[k, 1], line[k, 2] = dx, dy, dz
    line[k, 3], line[k, 4], line[k, 5] = ry * dz - rz * dy, rz * dx - rx * dz, rx * dy - ry * dx
    if n > 6:
        at = 6 + 6 * b
        rx, ry, rz = point[0] - origin[0], point[1] - origin[1], point[2] - origin[2]
        for a in range(3):
            line[k, at + a] = -direction[a]
        line[k, at + 3] = rz * direction[1] - ry * direction[2]
        line[k, at + 4] = rx * direction[2] - rz * direction[0]
        line[k, at + 5] = ry * direction[0] - rx * direction[1]


@njit(cache=True)
def in_face(edge: Vector, normal: Vector) -> tuple[Vector, Vector]:
    """Unit tangents of the object's bottom face (unit normal given), on which a block's edge slides: along, across."""
    x = edge[1] * normal[2] - edge[2] * normal[1]
    y = edge[2] * normal[0] - edge[0] * normal[2]
    z = edge[0] * normal[1] - edge[1] * normal[0]
    size = math.sqrt(x * x + y * y + z * z)
    x, y, z = x / size, y / size, z / size
    along = (normal[1] * z - normal[2] * y, normal[2] * x - normal[0] * z, normal[0] * y - normal[1] * x)
    return along, (x, y, z)


@njit(cache=True)
def add(work: Any, b: int, kind: int, slot: int, local: Vector, gap: float, k: float) -> None:
    """Append a contact of kind EDGE, FACE or SIDE at a point of block b's frame; k: its stiffness, N/mm."""
    if gap > NEAR_MM:
        return
    constants, state, trial = work.constants[0], work.state[0], work.trials[0]
    frame, origin, turn = trial.block_turn[b], trial.block[b], trial.world_turn
    x, y, z = apply(frame, local[0], local[1], local[2])
    point = (x + origin[0], y + origin[1], z + origin[2])
    # slide so far: where the object's and the block's material, both at the point now, were when the load step began
    x, y, z = apply_t(turn, point[0] - trial.world[0], point[1] - trial.world[1], point[2] - trial.world[2])
    x, y, z = apply(trial.start_turn, x, y, z)
    ax, ay, az = apply(state.block_turn[b], local[0], local[1], local[2])
    x = ax + state.block[b, 0] - x - trial.start[0]
    y = ay + state.block[b, 1] - y - trial.start[1]
    z = az + state.block[b, 2] - z - trial.start[2]
    normal = (-frame[0, 0], -frame[1, 0], -frame[2, 0])
    across = (frame[0, 2], frame[1, 2], frame[2, 2])
    along = (frame[0, 1], frame[1, 1], frame[2, 1])
    if kind != SIDE:
        normal, across = across, normal
    if kind == EDGE:
        normal = (turn[0, 2], turn[1, 2], turn[2, 2])
        along, across = in_face(along, normal)
    i = trial.filled
    trial.filled = i + 1
    row, n = work.rows[i], constants.unknowns
    _fill(row, trial, 0, n, b, normal, point)
    _fill(row, trial, 1, n, b, along, point)
    _fill(row, trial, 2, n, b, across, point)
    row.slide[0] = along[0] * x + along[1] * y + along[2] * z
    row.slide[1] = across[0] * x + across[1] * y + across[2] * z
    row.gap, row.stiffness, row.slot, row.friction = gap, k, slot, constants.edge_friction


@njit(cache=True)
def find_top(work: Any, b: int) -> None:
    """Contacts of the bottom face with block b's edge and of footprint vertices with its top."""
    trial, slots, corner = work.trials[0], work.slots, work.corner
    n = corner.shape[0]
    first, stiff = b * (2 + 2 * n), work.constants[0].contact_k
    shared = stiff if n <= SHARED_STIFFNESS else stiff * SHARED_STIFFNESS / n
    turn = trial.world_turn
    nx, ny, nz = apply_t(trial.block_turn[b], turn[0, 2], turn[1, 2], turn[2, 2])
    for k in range(n):
        x0, x1 = corner[k, 0], corner[(k + 1) % n, 0]
        if (x0 <= 0.0) != (x1 <= 0.0):
            y = corner[k, 1] + x0 / (x0 - x1) * (corner[(k + 1) % n, 1] - corner[k, 1])
            # the edge point (0, y, 0) against the plane of the bottom face
            gap = x0 * nx - (y - corner[k, 1]) * ny + corner[k, 2] * nz
            slot = first if x0 <= 0.0 else first + 1
            add(work, b, EDGE, slot, (0.0, y, 0.0), gap, stiff)
        if x0 > slots[first + 2 + k].rim:
            point = (x0, corner[k, 1], corner[k, 2])
            add(work, b, FACE, first + 2 + k, point, corner[k, 2], shared)


@njit(cache=True)
def hold_rim(work: Any, margin: float) -> None:
    """Have footprint vertices within margin mm of a block's edge count as they do now; margin 0: as they lie.

    A vertex that crosses the edge brings its share of the load with it at once; where that share pushes it back there
    is no equilibrium with it and none without.
    """
    slots, corner = work.slots, work.corner
    n = corner.shape[0]
    for b in range(2):
        locate(work, b)
        for k in range(n):
            slots[b * (2 + 2 * n) + 2 + k].rim = -margin if corner[k, 0] > 0.0 else margin


@njit(cache=True)
def find_side(work: Any, b: int) -> None:
    """Contacts of the prism's vertical edges with block b's wall and with its top edge."""
    trial, corner = work.trials[0], work.corner
    n = corner.shape[0]
    first, stiff = b * (2 + 2 * n), work.constants[0].contact_k
    shared = stiff if n <= SHARED_STIFFNESS else stiff * SHARED_STIFFNESS / n
    turn = trial.world_turn
    nx, ny, nz = apply_t(trial.block_turn[b], turn[0, 2], turn[1, 2], turn[2, 2])
    for k in range(n):
        x, y, z = corner[k, 0], corner[k, 1], corner[k, 2]
        if z >= 0.0:
            continue
        add(work, b, SIDE, first + 2 + k, (x, y, z), -x, shared)
        rise = -z / nz
        x, y = x + rise * nx, y + rise * ny
        add(work, b, SIDE, first + 2 + n + k, (x, y, 0.0), -x, shared)


@njit(cache=True)
def find_bases(work: Any, first: int) -> None:
    """The four base corners of each free block on the table."""
    constants, state, trial = work.constants[0], work.state[0], work.trials[0]
    size = constants.block_size
    for b in range(2):
        for c in range(4):
            lx, ly, lz = size[0] * (c % 2), size[1] * (0.5 if c < 2 else -0.5), -size[2]
            x, y, z = apply(trial.block_turn[b], lx, ly, lz)
            ax, ay, _ = apply(state.block_turn[b], lx, ly, lz)
            i = trial.filled
            trial.filled = i + 1
            row, at = work.rows[i], 6 + 6 * b
            line = row.line
            for k in range(3):
                for a in range(18):
                    line[k, a] = 0.0
            line[0, at + 2], line[0, at + 3], line[0, at + 4] = 1.0, y, -x
            line[1, at], line[1, at + 4], line[1, at + 5] = 1.0, z, -y
            line[2, at + 1], line[2, at + 3], line[2, at + 5] = 1.0, -z, x
            row.gap = z + trial.block[b, 2] + size[2]
            row.slide[0] = x + trial.block[b, 0] - ax - state.block[b, 0]
            row.slide[1] = y + trial.block[b, 1] - ay - state.block[b, 1]
            row.stiffness, row.slot, row.friction = constants.base_k, first + 4 * b + c, constants.table_friction


@njit(cache=True)
def refresh(work: Any, lagged: bool) -> None:
    """Rebuild all rows at the trial pose. lagged: friction bounds from the last step instead of from the gaps."""
    trial, unknowns = work.trials[0], work.constants[0].unknowns
    trial.filled = 0
    for a in range(unknowns):
        trial.xi[a] = 0.0
    product_into(trial.world_turn, trial.hand, trial.turn)
    x, y, z = apply(trial.hand, trial.place[0], trial.place[1], trial.place[2])
    trial.world[0], trial.world[1], trial.world[2] = x + trial.tcp[0], y + trial.tcp[1], z + trial.tcp[2]
    for b in range(2):
        locate(work, b)
        if work.state[0].mode[b] == TOP:
            find_top(work, b)
        else:
            find_side(work, b)
    if unknowns > 6:
        find_bases(work, 2 * (2 + 2 * work.foot.shape[0]))
    for i in range(trial.filled):
        row = work.rows[i]
        slot = work.slots[row.slot]
        force = slot.force if lagged else max(0.0, -row.gap * row.stiffness)
        row.bound = row.friction * force
        row.slide[0] += slot.slide[0]
        row.slide[1] += slot.slide[1]
