"""Contacts of an object's flat bottom and upright sides with a block, in the block's frame.

Block frame: origin in the middle of the inner top edge, x into the block, y along the edge, z up. The bottom face is
cut along the inner edge: the part over the block stands on its top (corners) or on its edge (the cut's ends). Below the
tops, the prism's upright edges lean on the wall.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from simulation.foreign.rigid import cross_matrix

Array = NDArray[np.float64]

ENTERED_MM = 0.5  # how much an object's depth must exceed its overlap to count as beside a block


class Properties(NamedTuple):
    """Contact properties: stiffness of an edge's end and of a corner, N/mm; friction."""

    stiffness: float
    shared: float
    friction: float


class Contacts(NamedTuple):
    """m possible contacts: points and normals [m, 3] (on the first body, work-object frame), gaps, mm, slots [m].

    travel [m, 3, 3]: motion of the point per unit of the first body's motion there. turns [m]: the normal is the
    object's.
    """

    points: Array
    normals: Array
    gaps: Array
    slots: NDArray[np.intp]
    stiffness: Array
    travel: Array
    turns: NDArray[np.bool_]
    friction: Array


def is_beside(corners: Array, was: bool) -> bool:
    """Whether an object with these corners leans on the block's wall instead of standing on its top."""
    below = corners[:, 2] < 0.0
    if was or not below.any():
        return was and bool(below.any())
    over = corners[:, 0] > 0.0
    depth = -float(corners[over, 2].min()) if over.any() else 0.0
    return not over.any() or depth > float(corners[:, 0].max()) + ENTERED_MM


def on_top(corners: Array, axis: Array, props: Properties) -> Contacts:
    """Corners over the block, and the ends of the block's edge below the bottom; block frame."""
    ahead = np.roll(corners, -1, axis=0)
    over = corners[:, 0] > 0.0
    cut, corner = np.flatnonzero(over != (ahead[:, 0] > 0.0)), np.flatnonzero(over)
    along = ahead[cut] - corners[cut]
    ends = corners[cut] + (corners[cut, 0] / (corners[cut, 0] - ahead[cut, 0]))[:, None] * along
    beside = along @ cross_matrix(axis)  # along x axis, the normal of the upright side through which the edge leaves
    shift = np.zeros((len(cut), 3, 3))
    shift[:, 1] = beside / np.where(np.abs(beside[:, 1:2]) > 0.07 * np.abs(beside[:, :1]), beside[:, 1:2], np.inf)
    slots = np.concatenate([np.where(over[cut], 0, 1), 2 + corner])
    return Contacts(
        np.concatenate([ends * [0.0, 1.0, 0.0], corners[corner]]),
        np.concatenate([np.tile(axis, (len(cut), 1)), np.tile([0.0, 0.0, 1.0], (len(corner), 1))]),
        np.concatenate([ends[:, 2] * axis[2], corners[corner, 2]]),
        slots,
        np.where(slots < 2, props.stiffness, props.shared),
        np.concatenate([shift, np.tile(np.eye(3), (len(corner), 1, 1))]),
        slots < 2,
        np.full(len(slots), props.friction),
    )


def against_wall(corners: Array, axis: Array, props: Properties) -> Contacts:
    """Upright edges of the object against the wall, at their lower ends and at the block's rim; block frame."""
    low = np.flatnonzero(corners[:, 2] < 0.0)
    rim = corners[low] - corners[low, 2:] / axis[2] * axis
    points, count = np.concatenate([corners[low], rim]), 2 * len(low)
    return Contacts(
        points,
        np.tile([-1.0, 0.0, 0.0], (count, 1)),
        -points[:, 0],
        np.concatenate([2 + low, 2 + len(corners) + low]),
        np.full(count, props.shared),
        np.tile(np.eye(3), (count, 1, 1)),
        np.zeros(count, np.bool_),
        np.full(count, props.friction),
    )
