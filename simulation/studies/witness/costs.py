"""The time cost of accuracy: our tiers and the finite elements against the finest mesh; mesh and load step refined.

All of them descend on one edge in equal parts of a depth. Errors are those of the end, of the markers since the grasp,
and of the depth at which a quarter of the contact slips.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from simulation.foreign.cell import ForeignCell, pad_of
from simulation.physics.quasistatic import QuasiStaticCell
from simulation.scene.scene import APPROACH_MM, Scene
from simulation.scene.state import Cell
from simulation.scene.worlds import load_scene
from simulation.studies.witness.check import FLAT, Probe

Array = NDArray[np.float64]
Make = Callable[[Scene], Cell]

PARTS, STOPS_AT = 4, 0.25
FINEST = (8, 3, 0.085)  # elements across and through, load step mm
MESHES = ((4, 1, 0.17), (6, 2, 0.17), (8, 2, 0.17), (6, 2, 0.34), (6, 2, 0.085))
EDGES: Mapping[str, Probe] = {
    "gel ends 0.5 mm beyond the markers": Probe(
        "", {"gel.poisson_ratio": 0.48, "gel.margin_mm": [0.5, 0.5]}, 8.0, 5.0, 1.2
    ),
}


class End(NamedTuple):
    """End of a descent: force on the object, N, turn in the hand, deg, markers' motion, mm, slip share, depth, CPU."""

    force: Array
    turn_deg: Array
    markers: Array
    slip: float
    stop_mm: float
    cpu_ms: float


def elements(across: int, through: int, step_mm: float) -> Make:
    """Finite elements with a mesh and a load step."""

    def make(scene: Scene) -> Cell:
        pad = pad_of(scene)._replace(columns=across, rows=across, layers=through)
        return ForeignCell(scene.varied({"numerics.load_step_mm": step_mm}), 0, pad)

    return make


def own(tier: str, *, edges: bool = True) -> Make:
    """A tier of our own physics; without edges its gel is endless."""

    def make(scene: Scene) -> Cell:
        return QuasiStaticCell(scene.varied({"gel.tier": tier} | ({} if edges else {"gel.margin_mm": None})))

    return make


CELLS: Mapping[str, Make] = {
    "bristle": own("bristle", edges=False),
    "layer": own("layer", edges=False),
    "layer with edges": own("layer"),
    **{f"finite elements, {a} x {a} x {b}, load step {step:g} mm": elements(a, b, step) for a, b, step in MESHES},
}


def descended(make: Make, probe: Probe) -> End:
    """A descent in PARTS of its depth; CPU time is that of the part below the approach height."""
    cell = make(load_scene("rectangle", blocks__free=False).varied({**FLAT, **probe.changes}))
    held = cell.regrasp(probe.x_mm, probe.theta_deg)
    x, y, z, yaw = cell.pose
    depths = probe.depth_mm * np.arange(PARTS + 1) / PARTS
    shares, began = [], time.process_time()
    for depth in depths:
        state = cell.move_to(x, y, z - APPROACH_MM - float(depth), float(np.degrees(yaw)))
        shares.append(float(np.mean(state.slipping_share)))
    cpu_ms = 1e3 * (time.process_time() - began)
    turn = np.degrees(state.in_hand[3:] - held.in_hand[3:])
    markers = (state.gel - held.gel)[..., :2].astype(float)
    stop = float(np.interp(STOPS_AT, np.maximum.accumulate(shares), depths)) if max(shares) >= STOPS_AT else np.nan
    return End(state.wrench_n_nmm[:3], turn, markers, shares[-1], stop, cpu_ms)


def measured(name: str, probe: Probe) -> Iterator[dict[str, Any]]:
    """One row per cell: its errors against the finest mesh and its cost."""
    finest = descended(elements(*FINEST), probe)
    for cell, make in CELLS.items():
        end = descended(make, probe)
        yield {
            "scene": name,
            "cell": cell,
            "cpu_ms": end.cpu_ms,
            "force_n": float(np.linalg.norm(end.force - finest.force)),
            "of_n": float(np.linalg.norm(finest.force)),
            "turn_deg": float(np.linalg.norm(end.turn_deg - finest.turn_deg)),
            "markers_um": float(1e3 * np.sqrt(np.square(end.markers - finest.markers).sum(axis=-1).mean())),
            "slip": end.slip - finest.slip,
            "stop_mm": None if np.isnan(end.stop_mm) else end.stop_mm - finest.stop_mm,
        }
