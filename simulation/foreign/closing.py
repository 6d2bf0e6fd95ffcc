"""Closing the fingers on an object held still except along y: it finds its place between them."""

import numpy as np
from numpy.typing import NDArray

from simulation.foreign.newton import Push
from simulation.foreign.pads import Grip

Array = NDArray[np.float64]


class Closing:
    """A drive of two motions, mm: the fingers' opening, under their force, and the object along y."""

    count = 2
    turns = False

    def __init__(self, side: Array, force_n: float) -> None:
        self._side, self.force_n = side, force_n

    def push(self, _grip: Grip) -> Push:
        """The gels push the fingers apart; the drive holds against them."""
        return Push(np.array([-self.force_n, 0.0]), lambda _careful: np.zeros((2, 2)))

    def lines(self, _grip: Grip, points: Array) -> Array:
        """Opening moves the gel's rest away from the nodes; the object takes the nodes along: [n, 3, 2]."""
        out = np.zeros((len(points), 3, 2))
        out[:, 1, 0], out[:, 1, 1] = -0.5 * self._side, 1.0
        return out

    def move(self, grip: Grip, motion: Array) -> None:
        """Open and shift by motion [2], mm."""
        grip.opening += float(motion[0])
        grip.place[1] += float(motion[1])

    def weight(self, force: Array) -> float:
        """Largest unbalanced force, N."""
        return float(np.abs(force).max())

    def reach(self, motion: Array) -> float:
        """Largest motion, mm."""
        return float(np.abs(motion).max())

    def memory(self) -> tuple[Array, ...]:
        """Empty: nothing moves except the grip."""
        return ()

    def recall(self, memory: tuple[Array, ...]) -> None:
        """Nothing to restore."""
