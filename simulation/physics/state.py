"""External view of the physics' poses."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def rest_blocks(state: Any, half_gap_mm: float, sink_mm: float) -> None:
    """Put both blocks at the gap's sides, where nothing has moved them, sunk into the table by their weight."""
    state["block_turn"][:] = np.stack([np.eye(3), np.diag([-1.0, -1.0, 1.0])])
    state["block"][:] = [[half_gap_mm, 0.0, -sink_mm], [-half_gap_mm, 0.0, -sink_mm]]


def block_motion(state: Any, half_gap_mm: float) -> Array:
    """Motion of both blocks, [2, 4]: dx, dy mm, yaw and tilt deg."""
    out = np.zeros((2, 4))
    for b, sign in enumerate((1.0, -1.0)):
        turn = state["block_turn"][b] * np.array([sign, sign, 1.0])
        out[b, :2] = state["block"][b, :2] - (sign * half_gap_mm, 0.0)
        out[b, 2] = math.degrees(math.atan2(turn[1, 0], turn[0, 0]))
        out[b, 3] = math.degrees(math.atan2(math.hypot(turn[2, 0], turn[2, 1]), turn[2, 2]))
    return out


def rotation_vector(turn: Array) -> Array:
    """Rotation vector [3] in rad of a rotation matrix with a small angle (under 90 deg)."""
    axis = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    sine = float(np.linalg.norm(axis))
    return np.asarray(axis * (math.asin(min(1.0, sine)) / sine if sine > 1e-12 else 1.0))
