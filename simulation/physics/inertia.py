"""Inertia of the held object, for scenes that need it: each load step becomes a step in time.

The step's time is its length over the arm's speed. Implicit Euler is the minimum of the quasi-static potential plus m /
(2 dt^2) |centre - coasting position|^2, so the solver stays unchanged; it damps, as rubber does. Only the centre of
mass has inertia: the objects turn by a few degrees while they slide by millimetres.
"""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from simulation.physics.kernels.records import Records
from simulation.scene.scene import Scene

Array = NDArray[np.float64]
YAW_ARM_MM = 40.0  # a yaw counts as the arc at this radius
INSTANT_S = 1e-9  # a wait that is a rounding error: m / dt^2 then drowns all other forces


class Coasting:
    """Velocity of the held object's centre of mass, mm/s in the world, carried from load step to load step."""

    def __init__(self, mass_kg: float, speed_mm_s: float, load_step_mm: float) -> None:
        self.mass_kg, self.speed_mm_s, self.load_step_mm = mass_kg, speed_mm_s, load_step_mm
        self.velocity = np.zeros(3)
        self._from, self._dt_s = np.zeros(3), 0.0

    def ride(self, travel: Array, speed_mm_s: float) -> None:
        """Nothing touches: the object moves with the hand along travel [3], mm, at the hand's speed."""
        length = float(np.linalg.norm(travel))
        if length > 0.0:
            self.velocity = travel * (speed_mm_s / length)

    def ticks(self, duration_s: float) -> list[float]:
        """Equal time steps of a wait, each as long as a load step takes at speed."""
        count = max(1, math.ceil(duration_s * self.speed_mm_s / self.load_step_mm - 1e-9))
        return [duration_s / count] * count

    def step(self, constants: Records, trials: Records, centre: Array, dt_s: float, solve: Callable[[], int]) -> int:
        """Solve a load step that takes dt_s seconds from centre [3], mm; without duration a quasi-static one."""
        self._from, self._dt_s = centre, dt_s
        if dt_s <= 0.0:
            return solve()
        trials["coast"][0] = centre + self.velocity * dt_s
        constants["inertia"] = 1e-3 * self.mass_kg / dt_s**2
        try:
            return solve()
        finally:
            constants["inertia"] = 0.0

    def arrive(self, centre: Array) -> None:
        """Record the object's centre at the end of a solved step."""
        if self._dt_s > 0.0:
            self.velocity = (centre - self._from) / self._dt_s


def duration_s(travel: Array, speed_mm_s: float) -> float:
    """Time of a motion (dx, dy, dz mm, yaw rad) at a speed."""
    return max(float(np.abs(travel[:3]).max()), YAW_ARM_MM * abs(float(travel[3]))) / speed_mm_s


def coasting_of(scene: Scene) -> Coasting:
    """An object at rest, moved at the scene's speed."""
    return Coasting(scene.object.mass_kg, scene.speed_mm_s, scene.numerics.load_step_mm)
