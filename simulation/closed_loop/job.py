"""What is played in the closed loop and what came of it."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from simulation.closed_loop.cameras import Camera, foreign_cameras, own_cameras
from simulation.physics.quasistatic import QuasiStaticCell
from simulation.scene.rubber import shear_reach_pitches
from simulation.scene.scene import Scene
from simulation.scene.state import Cell
from simulation.scene.worlds import World, load_scene

Perception = Literal["pictures", "fields"]
Who = Literal["belief", "heuristic", "oracle"]
MEASURED = 0.15
"""Standard deviation of the logarithm of a shear reach that a cell has measured by a press until slip."""


@dataclass(frozen=True, slots=True)
class Job:
    """One insertion to play: object, start error, seed, who decides, what it perceives, and the world.

    ``scene`` is an object by name or path. The start error is the one that the arm was commanded to. It is also
    the object's, unless the world misplaces the hand. ``condition`` names the world or disturbance; ``changes`` are
    its dotted keys of the scene, ``unstated`` those of its table `[world]`.
    ``told_reach``: the client also tells the gel's shear reach, with the error of a cell that has measured it.
    ``controller``: one of the service's, or the oracle, which moves by the true error: what is left is the first
    attempt and the creep in the hand.
    ``fault``: the fields of a `simulation.closed_loop.true_fields.Fault`, for perception "fields" alone.
    Perception "fields" takes the markers from the simulated gel instead of from pictures. ``cell`` "foreign": the
    mechanics are those of finite elements, the pictures its own. ``client``: tables of the client's configuration as
    in `cell.toml`; with them the arm starts above the approach and keeps its ramps, the descent's own and the time to
    settle.
    """

    scene: str
    index: int
    x_mm: float
    theta_deg: float
    seed: int
    controller: Who
    perception: Perception = "pictures"
    condition: str = ""
    changes: Mapping[str, Any] = field(default_factory=dict)
    unstated: Mapping[str, Any] = field(default_factory=dict)
    cell: Literal["", "foreign"] = ""
    fault: Mapping[str, Any] = field(default_factory=dict)
    told_reach: bool = False
    client: Mapping[str, Any] = field(default_factory=dict)

    def build_scene(self) -> Scene:
        """The object in its world; the blocks are free unless the world fixes them. Raises SceneError."""
        return load_scene(self.scene, blocks__free=True).varied(self.changes)

    def measured_reach_mm(self, scene: Scene) -> float | None:
        """The gel's shear reach as the client sends it, mm; None where nobody measured it."""
        if not self.told_reach:
            return None
        factor = math.exp(MEASURED * float(np.random.default_rng((self.seed, 2)).normal()))
        return factor * shear_reach_pitches(scene) * scene.sensor.marker_pitch_mm

    def mechanics(self) -> Callable[[Scene, int], Cell]:
        """What makes the cell's mechanics of a scene and a seed."""
        if self.cell != "foreign":
            return QuasiStaticCell
        from simulation.foreign.cell import ForeignCell  # brings scipy and scikit-fem

        return ForeignCell

    def cameras(self) -> Callable[[Scene, int], tuple[Camera, Camera]]:
        """What makes both fingers' cameras of a scene and a seed."""
        return foreign_cameras if self.cell == "foreign" else own_cameras


def job_in(world: World, scene: str, index: int, start: tuple[float, float], seed: int, **more: Any) -> dict[str, Any]:
    """Fields of a `Job` in a world, as plain data: the belief on true fields, unless ``more`` says otherwise."""
    return {
        "scene": scene,
        "index": index,
        "x_mm": float(start[0]),
        "theta_deg": float(start[1]),
        "seed": seed,
        "controller": "belief",
        "perception": "fields",
        "condition": world.name,
        "changes": dict(world.changes),
        "unstated": world.unstated.model_dump(mode="json", exclude_defaults=True),
        **more,
    }


@dataclass(slots=True)
class Course:
    """What happened to object and blocks up to now; lengths in mm, angles in deg.

    ``in_hand_mm`` is the object's largest displacement in the hand against the grasp (elastic and slipped),
    ``slipped_mm`` what of it was left once the object was in the air again.
    """

    block_mm: float = 0.0
    block_tilt_deg: float = 0.0
    in_hand_mm: float = 0.0
    slipped_mm: float = 0.0
    force_n: float = 0.0
    unsolved: int = 0


@dataclass(slots=True)
class Outcome:
    """One insertion: what was tried and how it ended. Errors are (x mm, theta deg) of the object before an attempt.

    ``inserted`` is a claim that is true, ``claimed`` what the client believes, ``in_gap`` the ground truth whether
    claimed or not, ``shortfalls`` what speaks against it; ``grasps``: how often it was taken; ``void``: the physics
    came to its end. ``seconds``: where the time went, see `Seconds`. ``fault_acted``: whether its fault came about.
    ``unseen_mm``: the furthest that the arm went down after the capture of a judged frame before the next one, where
    the client's lease allows ``unseen_allowed_mm``.
    """

    inserted: bool
    claimed: bool
    attempts: int
    reason: str
    void: bool
    final_error: tuple[float, float]
    grasp_kept: bool
    course: Course
    trials: list[dict[str, Any]] = field(default_factory=list)
    in_gap: bool = False
    seconds: dict[str, float] = field(default_factory=dict)
    shortfalls: tuple[str, ...] = ()
    grasps: int = 1
    fault_acted: bool = False
    unseen_mm: float = 0.0
    unseen_allowed_mm: float = 0.0

    @classmethod
    def never_held(cls, job: Job, reason: str) -> "Outcome":
        """Of an object that could not even be grasped."""
        start = (job.x_mm, job.theta_deg)
        return cls(False, False, 0, reason, True, start, grasp_kept=False, course=Course())
