"""What a moment of the simulated cell looks like to the outside, and why there may be none."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


Reason = Literal["gel squeezed through", "pads unsettled", "forces unbalanced", "friction unsettled"]


class PhysicsError(RuntimeError):
    """The equilibrium could not be found; the text says where. The cell's state is the last one that was found.

    reason: the grip is more than the gel bears; the layer's pads do not settle; no iteration balances the forces; or
    they balance, but the friction limits jump from round to round (stick and slip both end in the other).
    """

    def __init__(self, text: str, reason: Reason) -> None:
        super().__init__(text)
        self.reason: Reason = reason


@dataclass(frozen=True, slots=True)
class CellState:
    """One moment; forces and displacements are those at the end of the last move.

    gel: float32 [2, rows, columns, 3] = du mm, dv mm (finger frame), pressure N/mm2, at marker rest positions.
    slipping: bool [2, rows, columns], the gel there slid on the object in the last load step. slipping_share [2]: of
    the pressed nodes of a pad. wrench_n_nmm [6]: what blocks, gravity and inertia do to the object, at the TCP, hand
    frame. in_hand [6]: mm and rotation vector, rad. object_error: (x mm, theta deg). block_motion [2, 4]: dx, dy mm,
    yaw, tilt deg.
    """

    gel: NDArray[np.float32]
    slipping: NDArray[np.bool_]
    slipping_share: Array
    wrench_n_nmm: Array
    in_hand: Array
    object_error: tuple[float, float]
    bottom_z_mm: float
    block_motion: Array
    in_contact: bool
    shortfalls: tuple[str, ...]  # why it does not count as inserted, see `ground_truth`
    grasp_lost: bool
    residual_n: float

    @property
    def inserted(self) -> bool:
        """Ground truth of an insertion: nothing speaks against it."""
        return not self.shortfalls


def block_motion(state: Any, half_gap_mm: float) -> Array:
    """How both blocks have moved, [2, 4]: dx, dy mm, yaw and tilt deg."""
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
