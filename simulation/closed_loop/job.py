"""A job of the closed loop and its outcome."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from simulation.closed_loop.cameras import Camera, foreign_cameras, own_cameras
from simulation.physics.quasistatic import QuasiStaticCell
from simulation.scene.ground_truth import moved_mm
from simulation.scene.parts import Blocks
from simulation.scene.rubber import shear_reach_pitches
from simulation.scene.scene import Scene
from simulation.scene.state import Cell, CellState
from simulation.scene.worlds import World, freed, load_scene

Perception = Literal["pictures", "fields"]
Who = Literal["belief", "heuristic", "oracle"]
MEASURED = 0.15
"""Standard deviation of the logarithm of a shear reach that a cell has measured by pressing until slip."""


@dataclass(frozen=True, slots=True)
class Job:
    """One insertion to play, or one probe: object, start error, seed, controller, perception, and world.

    ``scene`` is an object by name or path. ``object_sha256`` are its contents when the job was made: kept rows of the
    same name and other contents do not count.

    The start error is the commanded one. It is also the object's, unless the world misplaces the hand.

    ``condition`` names the world or disturbance; ``changes`` are its dotted keys of the scene, ``unstated`` those of
    its table `[world]`.

    ``given_reach``: the client also sends the gel's shear reach, with the error of a cell that has measured it.
    ``commissioned``: a wiring check is taken to have shown which way each finger sees a turn, as on a cell also where
    it has missed what is wired wrong, or that came later.
    ``late_s``: the lateness of pictures and arm that its commissioning has measured; None: none.

    ``controller``: one of the service's, or the oracle, which moves by the true error: its remaining cost is the first
    attempt and the creep in the hand.

    ``fault``: the fields of a `simulation.closed_loop.true_fields.Fault`, for perception "fields" only. Perception
    "fields" takes the markers from the simulated gel instead of from pictures.

    ``cell`` "foreign": finite elements for the mechanics, with their own pictures.

    ``client``: tables of the client's configuration as in `cell.toml`; with them the arm starts above the approach and
    follows the client's ramps, descent and settling time.

    ``purpose`` "probe": it follows no correction, as the probes of a commissioning, and goes on to each of ``starts``
    (x mm, yaw deg) with the same grasp.
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
    given_reach: bool = False
    commissioned: bool = True
    late_s: float | None = None
    client: Mapping[str, Any] = field(default_factory=dict)
    purpose: Literal["insert", "probe"] = "insert"
    starts: Sequence[tuple[float, float]] = ()
    object_sha256: str = ""

    def build_scene(self) -> Scene:
        """The object in its world; the blocks are free unless its file or the world fixes them. Raises SceneError."""
        return freed(load_scene(self.scene)).varied(self.changes)

    def measured_reach_mm(self, scene: Scene) -> float | None:
        """The gel's shear reach as the client sends it, mm; None if it was not measured, or cannot be."""
        if not self.given_reach:
            return None
        factor = math.exp(MEASURED * float(np.random.default_rng((self.seed, 2)).normal()))
        return factor * shear_reach_pitches(scene) * scene.sensor.marker_pitch_mm or None  # 0: a gel without friction

    def mechanics(self) -> Callable[[Scene, int], Cell]:
        """Constructor of the cell's mechanics from a scene and a seed."""
        if self.cell != "foreign":
            return QuasiStaticCell
        from simulation.foreign.cell import ForeignCell  # imports scipy and scikit-fem

        return ForeignCell

    def cameras(self) -> Callable[[Scene, int], tuple[Camera, Camera]]:
        """Constructor of both fingers' cameras from a scene and a seed."""
        return foreign_cameras if self.cell == "foreign" else own_cameras


def job_in(world: World, scene: str, index: int, start: tuple[float, float], seed: int, **more: Any) -> dict[str, Any]:
    """Fields of a `Job` in a world, as plain data: the belief on true fields, unless ``more`` says otherwise.

    Raises SceneError for an object that cannot be read.
    """
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
        "object_sha256": load_scene(scene).sha256,
        **more,
    }


@dataclass(slots=True)
class Course:
    """The blocks' largest displacement and the largest force on the object so far."""

    block_mm: float = 0.0
    force_n: float = 0.0

    def take_in(self, state: CellState, blocks: Blocks) -> None:
        """Take in the next state of the cell with these blocks."""
        self.block_mm = max(self.block_mm, moved_mm(state.block_motion, blocks))
        self.force_n = max(self.force_n, float(np.linalg.norm(state.wrench_n_nmm[:3])))


@dataclass(slots=True)
class Outcome:
    """One insertion: its attempts and how it ended. Errors are (x mm, theta deg) of the object before an attempt.

    ``inserted``: a true claim. ``claimed``: what the client believes. ``in_gap``: the ground truth, claimed or not.
    ``shortfalls``: the evidence against insertion. ``grasps``: number of grasps. ``void``: the physics failed.
    ``seconds``: where the time went, see `Seconds`; empty if it never began. ``fault_acted``: whether its fault took
    effect. ``unseen_mm``: the furthest descent after the capture of one judged frame and before the next, where the
    client's lease allows ``unseen_allowed_mm``. ``grasp_height_mm``: as the client states it.
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
    grasp_height_mm: float | None = None

    @classmethod
    def never_began(cls, job: Job, reason: str, *, void: bool = False) -> "Outcome":
        """The outcome for an object that could not be grasped (void), or that nobody was allowed to insert."""
        start = (job.x_mm, job.theta_deg)
        return cls(False, False, 0, reason, void, start, grasp_kept=False, course=Course())
