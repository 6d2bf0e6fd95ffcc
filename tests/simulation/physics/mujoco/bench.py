"""The same pokes in our mechanics and in MuJoCo, an independent check of equilibrium, friction and contact."""

from dataclasses import dataclass

import numpy as np

from simulation.data.probe import QuasiStaticCell
from simulation.scene.worlds import load_scene
from tests.simulation.physics.mujoco.model import Effort
from tests.simulation.physics.mujoco.press import Press, Pressed
from tests.simulation.physics.mujoco.scenes import SETTINGS, Poke

FINE = Effort(0.1, 1000.0, 0.9995, 0.5, 0.02)
COARSER = (Effort(0.1, 500.0, 0.9995, 0.5, 0.02), Effort(0.1, 1000.0, 0.998, 1.0, 0.08))  # twice as fast; softer
LOAD_STEPS_MM = (0.17, 0.02)


def ours(poke: Poke, load_step_mm: float) -> tuple[QuasiStaticCell, Pressed]:
    """A freshly grasped cell, and the end of the poke by our own mechanics."""
    cell = QuasiStaticCell(load_scene(poke.scene, numerics__load_step_mm=load_step_mm, **{**SETTINGS, **poke.changes}))
    cell.regrasp(poke.x_mm, poke.theta_deg)
    x, _, _, yaw = cell.pose
    state = cell.move_to(x, 0.0, cell.scene.grasp.height_mm - poke.depth_mm, np.degrees(yaw))
    cell.regrasp(poke.x_mm, poke.theta_deg)
    return cell, Pressed(state.wrench_n_nmm[:3], np.degrees(state.in_hand[3:]))


def theirs(poke: Poke, cell: QuasiStaticCell, effort: Effort) -> Pressed:
    """The end of the poke by MuJoCo, from the grasp of a cell of ours."""
    return Press(cell, effort, poke.depth_mm, apart=poke.apart).run()


@dataclass(frozen=True)
class Comparison:
    """Both simulators on one poke: norms of our vectors, distance to theirs, and the sum of both refinement errors."""

    force_n: float
    turn_deg: float
    force_apart_n: float
    force_allowed_n: float
    turn_apart_deg: float
    turn_allowed_deg: float

    @property
    def agree(self) -> bool:
        """Within the sum of both refinement errors."""
        return self.force_apart_n <= self.force_allowed_n and self.turn_apart_deg <= self.turn_allowed_deg


def _apart(one: Pressed, other: Pressed) -> tuple[float, float]:
    return float(np.linalg.norm(one.force_n - other.force_n)), float(np.linalg.norm(one.turn_deg - other.turn_deg))


def compare(poke: Poke) -> Comparison:
    """Both simulators at their finest on one poke.

    Refinement errors: ours between two load steps; MuJoCo's are what speed and softness change, one by one and summed,
    as they pull opposite ways (a fast object lags behind, a soft contact creeps).
    """
    (_, rough), (cell, mine) = (ours(poke, step) for step in LOAD_STEPS_MM)
    fine = theirs(poke, cell, FINE)
    (force, turn), own = _apart(mine, fine), _apart(rough, mine)
    other = np.sum([_apart(theirs(poke, cell, effort), fine) for effort in COARSER], axis=0).tolist()
    return Comparison(
        force_n=float(np.linalg.norm(mine.force_n)),
        turn_deg=float(np.linalg.norm(mine.turn_deg)),
        force_apart_n=force,
        force_allowed_n=own[0] + other[0],
        turn_apart_deg=turn,
        turn_allowed_deg=own[1] + other[1],
    )
