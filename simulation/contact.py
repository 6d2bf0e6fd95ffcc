"""Where the object's prism meets the two blocks: exact clipping of the footprint against edge, top and wall.

Block frame: origin on the inner top edge, x into the block, z up, so that both blocks run the same code. A contact is a
slot (block, index) that keeps its friction memory from step to step: slots 0 and 1 are the two ends of the block's edge
under the footprint, then one per footprint vertex (on the top face, or against the wall below it), then one per
vertical edge of the prism where it passes the block's top edge. Block 0 is at +x, block 1 at -x.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from simulation.linear import apply, apply_t, cross, dot

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

TOP, WALL = 0, 1
NEAR_MM = 1.0


class Rows(NamedTuple):
    """Active contacts of one linearisation: m rows over the twist of object and blocks.

    normal [m, n], tangent [m, 2, n], gap [m] mm, slide [m, 2] mm trial stretch, stiffness [m], bound [m] N, slot [m]
    (block * slots + index, or -1). All are filled up to `filled[0]`.
    """

    normal: Array
    tangent: Array
    gap: Array
    slide: Array
    stiffness: Array
    bound: Array
    slot: Ints
    filled: Ints


def make_rows(vertices: int, unknowns: int) -> Rows:
    """Empty storage, large enough for every slot and for both blocks' bases."""
    m = 2 * (2 + 2 * vertices) + 16
    return Rows(
        np.zeros((m, unknowns)),
        np.zeros((m, 2, unknowns)),
        np.zeros(m),
        np.zeros((m, 2)),
        np.zeros(m),
        np.zeros(m),
        np.zeros(m, dtype=np.int64),
        np.zeros(1, dtype=np.int64),
    )


@njit(cache=True)
def locate(foot: Array, bottom: float, turn: Array, place: Array, block_turn: Array, block: Array, out: Array) -> None:
    """Footprint vertices in the block's frame into out [v, 3]. turn, place: the object's pose in the world."""
    point = np.empty(3)
    for k in range(foot.shape[0]):
        point[0], point[1], point[2] = foot[k, 0], foot[k, 1], bottom
        out[k] = apply_t(block_turn, apply(turn, point) + place - block)


@njit(cache=True)
def update_mode(local: Array, mode: int) -> int:
    """Top or wall contact, with memory: a footprint must clear the block to enter, and rise above its top to leave."""
    overlap, lowest, depth = -1e9, 1e9, 0.0
    for k in range(local.shape[0]):
        overlap = max(overlap, local[k, 0])
        lowest = min(lowest, local[k, 2])
        if local[k, 0] > 0.0:
            depth = max(depth, -local[k, 2])
    if mode == TOP and lowest < 0.0 and (overlap <= 0.0 or depth > overlap + 0.5):
        return WALL
    if mode == WALL and lowest >= 0.0:
        return TOP
    return mode


@njit(cache=True)
def add_row(
    rows: Rows,
    point: Array,
    normal: Array,
    axes: Array,
    gap: float,
    moved: Array,
    stiffness: float,
    slot: int,
    hand: Array,
    tcp: Array,
    block: int,
    block_place: Array,
) -> None:
    """Append one contact at a world point. hand [3, 3]: hand to world; axes [2, 3]: tangents.

    Moved [3]: slide so far.
    """
    i = rows.filled[0]
    rows.filled[0] = i + 1
    rows.gap[i], rows.stiffness[i], rows.slot[i] = gap, stiffness, slot
    for a in range(3):
        direction = normal if a == 0 else axes[a - 1]
        row = rows.normal[i] if a == 0 else rows.tangent[i, a - 1]
        local = apply_t(hand, direction)
        row[:] = 0.0
        row[0:3] = local
        row[3:6] = cross(apply_t(hand, point - tcp), local)
        if row.shape[0] > 6:
            first = 6 + 6 * block
            row[first : first + 3] = -direction
            row[first + 3 : first + 6] = -cross(point - block_place, direction)
        if a > 0:
            rows.slide[i, a - 1] = dot(direction, moved)


@njit(cache=True)
def clip_top(local: Array, normal: Array, found: Array, index: Ints) -> int:
    """Contacts on the block's edge and top face, in the block's frame: found [k, 4] = point, gap; index [k]."""
    count, edge = 0, 0
    n = local.shape[0]
    for k in range(n):
        x0, x1 = local[k, 0], local[(k + 1) % n, 0]
        if (x0 <= 0.0) != (x1 <= 0.0):
            share = x0 / (x0 - x1)
            y = local[k, 1] + share * (local[(k + 1) % n, 1] - local[k, 1])
            # the edge point (0, y, 0) against the plane of the bottom face, whose upward normal is `normal`
            gap = -((-local[k, 0]) * normal[0] + (y - local[k, 1]) * normal[1] - local[k, 2] * normal[2])
            found[count, 0], found[count, 1], found[count, 2], found[count, 3] = 0.0, y, 0.0, gap
            index[count] = 0 if x0 <= 0.0 else 1
            edge += 1
            count += 1
        if x0 > 0.0:
            found[count, 0:3] = local[k]
            found[count, 3] = local[k, 2]
            index[count] = 2 + k
            count += 1
    return count


@njit(cache=True)
def clip_wall(local: Array, normal: Array, found: Array, index: Ints) -> int:
    """Contacts of the prism's vertical edges with the block's wall and top edge, in the block's frame."""
    count = 0
    n = local.shape[0]
    for k in range(n):
        if local[k, 2] >= 0.0:
            continue
        if local[k, 0] > -NEAR_MM:
            found[count, 0:3] = local[k]
            found[count, 3] = -local[k, 0]
            index[count] = 2 + k
            count += 1
        rise = -local[k, 2] / normal[2]
        x = local[k, 0] + rise * normal[0]
        if x > -NEAR_MM:
            found[count, 0], found[count, 1], found[count, 2] = x, local[k, 1] + rise * normal[1], 0.0
            found[count, 3] = -x
            index[count] = 2 + n + k
            count += 1
    return count
