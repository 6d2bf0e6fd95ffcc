"""Closing the fingers on the object."""

from simulation.physics.kernels import load_step
from simulation.physics.kernels.records import Workspace
from simulation.scene.scene import Scene
from simulation.scene.state import PhysicsError

BISECTIONS = 60
UNEVEN = 0.5  # ratio of the pads' forces from which the object cannot be at its assumed position


def close_fingers(scene: Scene, work: Workspace) -> None:
    """Close to the grip force: bisection on the opening. Raises PhysicsError.

    The object is held still, unless a face lies on one finger and a corner on the other: then the fingers push it, by
    at most a pad's thickness, to where both pads bear the same force.
    """
    _close(scene, work, free=False)
    one, other = _grips(work)
    if min(one, other) < UNEVEN * max(one, other):
        _close(scene, work, free=True)


def _close(scene: Scene, work: Workspace, *, free: bool) -> None:
    crest = 2.0 * float(work.constants["profile"][0, 0])
    wide, tight = crest + 8.0, crest - 1.9 * scene.gel.thickness_mm

    def grip(opening: float) -> float:
        work.state["opening"][0] = opening
        load_step.grip_pressures(work)
        if free:
            _push_to_the_middle(work, scene.gel.thickness_mm)
        return 0.5 * sum(_grips(work))

    if grip(tight) < scene.grasp.force_n:
        raise PhysicsError(
            f"grasp.force_n: {scene.grasp.force_n} N squeezes the gel through; it bears {grip(tight):.1f} N",
            "gel squeezed through",
        )
    for _ in range(BISECTIONS):
        middle = 0.5 * (wide + tight)
        wide, tight = (wide, middle) if grip(middle) > scene.grasp.force_n else (middle, tight)
    grip(tight)


def _push_to_the_middle(work: Workspace, reach_mm: float) -> None:
    """Bisection on the object's position between the fingers: the finger that bears more pushes it to the other."""
    low, high = -reach_mm, reach_mm
    for _ in range(BISECTIONS):
        work.state["place"][0, 1] = 0.5 * (low + high)
        load_step.grip_pressures(work)
        one, other = _grips(work)
        low, high = (0.5 * (low + high), high) if one < other else (low, 0.5 * (low + high))


def _grips(work: Workspace) -> tuple[float, float]:
    """The normal forces of both pads, N."""
    one, other = work.nodes["pressure"].reshape(2, -1).sum(axis=1) * work.constants["area"][0]
    return float(one), float(other)
