"""The time cost of physics accuracy, against converged references.

Each scene is poked once (1.5 mm past touchdown, friction partly slipping), varying one parameter at a time. Errors are
those of the held object's pose, of the force and of the markers' motion at the end of the poke. They are taken against
the same tier, converged (the cost of load step and node count), and against the converged layer tier (the cost of the
model).
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import cv2
import numpy as np

from reporting.machine import best_cpu_ms
from service.contract import FINGERS
from simulation.data.probe import run_probe
from simulation.optics.appearance import Appearance
from simulation.optics.renderer import Renderer
from simulation.physics.quasistatic import QuasiStaticCell
from simulation.scene.scene import Scene
from simulation.scene.state import CellState
from simulation.scene.worlds import load_scene, training_objects

Tier = Literal["bristle", "layer"]
Changes = dict[str, Any]

X_MM, THETA_DEG, PAST_TOUCHDOWN_MM = 8.0, 5.0, 1.5
CLEAN: Changes = {"grasp__pre_tilt_spread_deg": 0.0, "grasp__pre_yaw_spread_deg": 0.0}
FINE, FINER = {"gel__node_rows": 40, "gel__node_columns": 42}, {"gel__node_rows": 60, "gel__node_columns": 63}
COARSE = {"gel__node_rows": 10, "gel__node_columns": 11}
REFERENCES: dict[Tier, Changes] = {
    "bristle": {"numerics__load_step_mm": 0.01, **FINER},
    "layer": {"gel__tier": "layer", "numerics__load_step_mm": 0.02, **FINE},
}


@dataclass(frozen=True, slots=True)
class Setting:
    """One way to compute: its name, its group in the picture, tier and changed keys."""

    name: str
    family: Literal["load step", "nodes", "effects", "layer"]
    tier: Tier
    changes: Changes


SETTINGS = (
    Setting("load step 0.50 mm", "load step", "bristle", {"numerics__load_step_mm": 0.5}),
    Setting("load step 0.34 mm", "load step", "bristle", {"numerics__load_step_mm": 0.34}),
    Setting("default: load step 0.17 mm, 20 x 21 nodes", "load step", "bristle", {}),
    Setting("load step 0.04 mm", "load step", "bristle", {"numerics__load_step_mm": 0.04}),
    Setting("load step 0.01 mm", "load step", "bristle", {"numerics__load_step_mm": 0.01}),
    Setting("10 x 11 nodes", "nodes", "bristle", COARSE),
    Setting("40 x 42 nodes", "nodes", "bristle", FINE),
    Setting("40 x 42 nodes, load step 0.04 mm", "nodes", "bristle", {**FINE, "numerics__load_step_mm": 0.04}),
    Setting("edge friction left out", "effects", "bristle", {"effects__edge_friction": "off"}),
    Setting("gel coupling left out", "effects", "bristle", {"effects__gel_coupling": "off"}),
    Setting("gravity forced on", "effects", "bristle", {"effects__gravity": "on"}),
    Setting("layer, load step 0.50 mm", "layer", "layer", {"numerics__load_step_mm": 0.5}),
    Setting("layer, load step 0.17 mm, 20 x 21 nodes", "layer", "layer", {}),
    Setting("layer, load step 0.04 mm", "layer", "layer", {"numerics__load_step_mm": 0.04}),
    Setting("layer, 10 x 11 nodes", "layer", "layer", COARSE),
)


@dataclass(frozen=True, slots=True)
class Error:
    """Differences of an end state from a reference; markers are RMS over both fingers, against the state at rest."""

    position_um: float
    turn_deg: float
    force_n: float
    markers_um: float


@dataclass(frozen=True, slots=True)
class Cost:
    """One scene under one setting: CPU time of the poke, errors against its own tier's and the layer's reference."""

    scene: str
    setting: str
    family: str
    tier: Tier
    cpu_ms: float
    numerical: Error
    model: Error


@dataclass(frozen=True, slots=True)
class End:
    """End of a poke: the state, the markers' motion since the grasp (mm), best CPU time in ms."""

    state: CellState
    motion: np.ndarray[tuple[int, ...], np.dtype[np.float32]]
    cpu_ms: float


def poke(scene: str, tier: Tier, changes: Changes, repeats: int) -> End:
    """Poke a scene; CPU time is the best of ``repeats``."""
    cell, best = QuasiStaticCell(load_scene(scene, **{"gel__tier": tier, **CLEAN, **changes})), float("inf")
    for _ in range(repeats):
        held = cell.regrasp(X_MM, THETA_DEG)
        x, y, z, yaw = cell.pose
        start = time.process_time()
        state = cell.move_to(x, y, z - 5.0 - PAST_TOUCHDOWN_MM, float(np.degrees(yaw)))
        best = min(best, 1e3 * (time.process_time() - start))
    return End(state, (state.gel - held.gel)[..., :2], best)


def error_of(end: End, reference: End) -> Error:
    """Differences of a poke's end from the reference's."""
    shift = end.state.in_hand - reference.state.in_hand
    force = end.state.wrench_n_nmm[:3] - reference.state.wrench_n_nmm[:3]
    return Error(
        position_um=float(1e3 * np.linalg.norm(shift[:3])),
        turn_deg=float(np.degrees(np.linalg.norm(shift[3:]))),
        force_n=float(np.linalg.norm(force)),
        markers_um=float(1e3 * np.sqrt(np.mean(np.sum((end.motion - reference.motion) ** 2, axis=-1)))),
    )


def measure(repeats: int, show: Callable[[int], None]) -> list[Cost]:
    out: list[Cost] = []
    for scene in training_objects():
        references = {tier: poke(scene, tier, changes, 1) for tier, changes in REFERENCES.items()}
        for setting in SETTINGS:
            end = poke(scene, setting.tier, setting.changes, repeats)
            errors = error_of(end, references[setting.tier]), error_of(end, references["layer"])
            out.append(Cost(scene, setting.name, setting.family, setting.tier, end.cpu_ms, *errors))
            show(len(out))
    return out


def probe_times(repeats: int) -> dict[str, dict[str, float]]:
    """Best CPU time, ms, of a whole probe per scene on one core: marker fields of each tier; 2 x 30 frames."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        return {name: _probe_times(load_scene(name), repeats) for name in training_objects()}
    finally:
        cv2.setNumThreads(threads)


def _probe_times(scene: Scene, repeats: int) -> dict[str, float]:
    out = {}
    for tier in ("bristle", "layer"):
        cell = QuasiStaticCell(scene.varied({"gel.tier": tier}))
        out[f"{tier}, marker fields"] = best_cpu_ms(partial(run_probe, cell, X_MM, THETA_DEG), repeats)
    gel = run_probe(scene, X_MM, THETA_DEG).gel.astype(np.float32)
    renderers = [Renderer(Appearance.draw(scene, finger, 0)) for finger in FINGERS]

    def draw() -> None:
        for i, fields in enumerate(gel):
            for renderer, now, before in zip(renderers, fields, gel[max(0, i - 1)], strict=True):
                renderer.rectified(now, i, before)

    out["images of 2 x 30 frames"] = best_cpu_ms(draw, repeats)
    out["bristle, fields and images"] = out["bristle, marker fields"] + out["images of 2 x 30 frames"]
    return out
