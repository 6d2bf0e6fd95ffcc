"""How a hand yields beyond its rubber's elasticity: fingers that bend across the gap, and gels that relax.

A compliant finger is one spring along x behind its pad, which condensation removes. A gel that relaxes has one Prony
branch of the same share in all its stiffness: what has crept is a displacement that leaves no force.
"""

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Springs:
    """Both fingers on springs along x, N/mm.

    A pad's base moves by b where pad and spring balance: k b = e K (u - b e), where e is a unit shift of all nodes.
    stiffness: of both pads [3 n, 3 n] with their springs, condensed.
    """

    def __init__(self, stiffness: tuple[Array, Array], n_per_mm: float) -> None:
        self._count = len(stiffness[0]) // 3
        shift = np.tile([1.0, 0.0, 0.0], self._count)
        answers = [own @ shift for own in stiffness]
        self._bend = [answer / (n_per_mm + float(shift @ answer)) for answer in answers]
        left, right = (
            own - np.outer(answer, bend) for own, answer, bend in zip(stiffness, answers, self._bend, strict=True)
        )
        self.stiffness = left, right

    def bent(self, motion: Array) -> Array:
        """How far along x its finger has bent at each node [2 n], mm, under nodes moved by motion [2 n, 3]."""
        parts = motion.reshape(2, -1)
        return np.repeat([bend @ part for bend, part in zip(self._bend, parts, strict=True)], self._count)


class Creep:
    """The crept displacement [n, 3], mm: of the traction of a displacement, `share` is lost by exp(-t / time_s).

    Only displacement since the grasp creeps: the gripper keeps the force of closing.
    """

    def __init__(self, count: int, share: float, time_s: float) -> None:
        self._share, self._time_s = share, time_s
        self.by: Array = np.zeros((count, 3))
        self._grasped = self.by

    def begin(self, displacement: Array) -> None:
        """The object is held, with the gel displaced [n, 3]."""
        self.by, self._grasped = np.zeros_like(self.by), displacement

    def let_go(self) -> None:
        """A new grasp begins: the gel is as it was moulded."""
        self.by = np.zeros_like(self.by)

    def hold(self, displacement: Array, time_s: float) -> None:
        """Hold a displacement [n, 3] for a time, s. Exact."""
        goal = self._share * (displacement - self._grasped)
        self.by = goal + (self.by - goal) * math.exp(-time_s / self._time_s)
