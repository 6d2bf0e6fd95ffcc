"""The observable state of a simulated cell, its failures, and the interface of a cell."""

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from simulation.scene.scene import Scene

Array = NDArray[np.float64]


Reason = Literal["gel squeezed through", "pads unsettled", "forces unbalanced", "friction unsettled"]


class PhysicsError(RuntimeError):
    """No equilibrium was found; the text says where. The cell keeps its last equilibrium.

    reason: the grip exceeds what the gel bears; the layer's pads do not settle; no iteration balances the forces; or
    they balance, but the friction limits jump from round to round (stick and slip each lead to the other).
    """

    def __init__(self, text: str, reason: Reason) -> None:
        super().__init__(text)
        self.reason: Reason = reason


class TouchingError(ValueError):
    """The hand was to be tilted although its object touches a block."""


@dataclass(frozen=True, slots=True)
class CellState:
    """One moment; forces and displacements are those at the end of the last move.

    gel: float32 [2, rows, columns, 3 or more] = du mm, dv mm (finger frame), pressure N/mm2, at marker rest positions,
    and any further values for the cell's own cameras. slipping: bool [2, rows, columns], the gel there slid on the
    object in the last load step. slipping_share [2]: share of a pad's pressed nodes. wrench_n_nmm [6]: of blocks,
    gravity and inertia on the object, at the TCP, hand frame. in_hand [6]: mm and rotation vector, rad. object_error:
    (x mm, theta deg). block_motion [2, 4]: dx, dy mm, yaw, tilt deg.
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
        """Ground truth of an insertion: there are no shortfalls."""
        return not self.shortfalls


class Cell(Protocol):
    """A simulated cell: a hand with an object above a gap. Frames and signs are those of the work object.

    ``pose`` [4]: the TCP's x, y, z in mm and its yaw in rad. ``tilt_rad``: of the hand about its own y, 0 after a
    regrasp.
    """

    scene: Scene
    pose: Array
    tilt_rad: float
    pace_mm_s: float
    """Speed of the moves that follow, where it matters."""

    @property
    def relaxes(self) -> bool:
        """Whether anything changes while the hand stands still."""

    def wait(self, time_s: float, /) -> CellState:
        """Stand still for a while. Raises PhysicsError as `move_to` does."""

    def regrasp(self, x_mm: float, theta_deg: float) -> CellState:
        """Regrasp the object with the given error, at approach height. Raises PhysicsError."""

    def reset_blocks(self) -> None:
        """Put both blocks back at the scene's positions."""

    def move_to(self, x_mm: float, y_mm: float, z_mm: float, yaw_deg: float) -> CellState:
        """Move the TCP in a straight line. Raises PhysicsError where no equilibrium is found."""

    def tilt_to(self, tilt_deg: float) -> CellState:
        """Tilt the hand about its own y, the object with it; only clear of the blocks, else ValueError."""

    def look(self) -> CellState:
        """The state now, without moving."""
