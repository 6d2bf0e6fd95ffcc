"""Closing the fingers on the object."""

from __future__ import annotations

from simulation.physics.kernels import load_step
from simulation.physics.kernels.records import Workspace
from simulation.scene.scene import Scene
from simulation.scene.state import PhysicsError

BISECTIONS = 60


def close_fingers(scene: Scene, work: Workspace) -> None:
    """Close to the grip force: bisection on the opening, the object held still. Raises PhysicsError."""
    constants, nodes = work.constants, work.nodes
    crest = 2.0 * float(constants["profile"][0, 0])
    wide, tight = crest + 8.0, crest - 1.9 * scene.gel.thickness_mm
    area = float(constants["area"][0])

    def grip(opening: float) -> float:
        work.state["opening"][0] = opening
        load_step.grip_pressures(work)
        return 0.5 * float(nodes["pressure"].sum()) * area

    if grip(tight) < scene.grasp.force_n:
        raise PhysicsError(
            f"grasp.force_n: {scene.grasp.force_n} N squeezes the gel through; it bears {grip(tight):.1f} N",
            "gel squeezed through",
        )
    for _ in range(BISECTIONS):
        middle = 0.5 * (wide + tight)
        wide, tight = (wide, middle) if grip(middle) > scene.grasp.force_n else (middle, tight)
    grip(tight)
