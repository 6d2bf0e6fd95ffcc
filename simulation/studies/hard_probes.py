"""Random hard probes: touchdown, edge on edge, friction from none to 2, soft and hard blocks, loss of grip.

Each must end solved, with the object lost from the grasp, or refused by a typed reason. A solved probe is finite,
balanced and inside the friction cones. The same (seed, number) is the same probe on every machine.
"""

import math
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np

from simulation.data.parallel import results
from simulation.foreign.cell import ForeignCell
from simulation.physics.quasistatic import QuasiStaticCell
from simulation.scene.scene import Scene
from simulation.scene.state import CellState, PhysicsError
from simulation.scene.worlds import load_scene, object_names

RESIDUAL_N, CONE_N_PER_MM2 = 1e-6, 1e-9  # limits for a solved probe
DEPTHS_MM = (5.05, 5.6, 6.5, 5.2)  # just touching, sliding, deep, and back up
CHUNK = 50
FOREIGN = "foreign"
RUBBER = {"gel.poisson_ratio": 0.48, "gel.margin_mm": [1.0, 1.0]}  # of the foreign cell, whose gels end


class ImpossibleStateError(AssertionError):
    """A probe reported as solved violates a guarantee: a non-finite number, a residual, a friction cone."""


@dataclass(slots=True)
class Tally:
    """How hard probes ended: outcome or "refused: reason" -> count; the worst figures of the solved ones."""

    ended: Counter[str] = field(default_factory=Counter)
    worst_residual_n: float = 0.0
    worst_cone_n_per_mm2: float = -math.inf
    cpu_s: float = 0.0

    def add(self, other: "Tally") -> None:
        self.ended += other.ended
        self.worst_residual_n = max(self.worst_residual_n, other.worst_residual_n)
        self.worst_cone_n_per_mm2 = max(self.worst_cone_n_per_mm2, other.worst_cone_n_per_mm2)
        self.cpu_s += other.cpu_s

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Self:
        cpu_s = 1e-3 * data["cpu_ms_per_probe"] * data["probes"]
        return cls(Counter(data["ended"]), data["worst_residual_n"], data["worst_cone_violation_n_per_mm2"], cpu_s)

    def as_dict(self) -> dict[str, Any]:
        return {
            "probes": self.ended.total(),
            "ended": dict(sorted(self.ended.items())),
            "worst_residual_n": self.worst_residual_n,
            "worst_cone_violation_n_per_mm2": max(0.0, self.worst_cone_n_per_mm2),
            "cpu_ms_per_probe": 1e3 * self.cpu_s / max(1, self.ended.total()),
        }


def hard_scene(rng: np.random.Generator, tier: str) -> Scene:
    """One of the eight objects with hard contact, grip and numbers."""
    return load_scene(
        object_names()[int(rng.integers(len(object_names())))],
        gel__tier=tier,
        gel__friction=float(rng.choice([0.0, 0.2, 0.8, 2.0])),
        blocks__friction=float(rng.choice([0.0, 0.25, 1.0])),
        blocks__stiffness_n_per_mm=float(10.0 ** rng.uniform(1.0, 4.0)),
        blocks__free=bool(rng.random() < 0.5),
        grasp__force_n=float(rng.uniform(1.0, 60.0)),
        numerics__load_step_mm=float(rng.choice([0.05, 0.17, 0.5])),
    )


def hard_probe(seed: int, number: int, tier: str, tally: Tally) -> str:
    """Run one probe, tally it and return its outcome. Raises ImpossibleStateError on a violated guarantee."""
    rng = np.random.default_rng((seed, number))
    start = time.process_time()
    try:
        ended = _descend(hard_scene(rng, "bristle" if tier == FOREIGN else tier), rng, tier, tally)
    except PhysicsError as error:
        ended = f"refused: {error.reason}"
    tally.cpu_s += time.process_time() - start
    tally.ended[ended] += 1
    return ended


def _descend(scene: Scene, rng: np.random.Generator, tier: str, tally: Tally) -> str:
    seed = int(rng.integers(1 << 30))
    own = tier != FOREIGN
    cell = QuasiStaticCell(scene, seed) if own else ForeignCell(scene.varied(RUBBER), seed)
    span = scene.x_range_mm
    cell.regrasp(float(rng.uniform(-span, span)), float(rng.uniform(-15.0, 15.0)))
    x, y, z, yaw = cell.pose
    for depth in DEPTHS_MM:
        state = cell.move_to(x, y, z - depth, math.degrees(yaw))
        if state.grasp_lost:
            return "grasp lost"
        _check(cell, state)
        tally.worst_residual_n = max(tally.worst_residual_n, state.residual_n)
        tally.worst_cone_n_per_mm2 = max(tally.worst_cone_n_per_mm2, _cone(cell))
    return "solved"


def _cone(cell: QuasiStaticCell | ForeignCell) -> float:
    """Excess of friction over its cone at the worst node, N/mm2."""
    if isinstance(cell, QuasiStaticCell):
        return float(cell.state["report"][4])
    terms = cell.pads.evaluate(cell.grip, cell.pads.planes(cell.held, cell.grip.on), cell.grip.on, None)
    beyond = np.linalg.norm(terms.drag, axis=1) - cell.pads.friction * np.maximum(terms.pressing, 0.0)
    return float((beyond / cell.pads.area).max())


def _check(cell: QuasiStaticCell | ForeignCell, state: CellState) -> None:
    numbers = (state.gel, state.wrench_n_nmm, state.in_hand, state.block_motion)
    if not all(np.isfinite(array).all() for array in numbers):
        raise ImpossibleStateError(f"{cell.scene.name}: a non-finite number at TCP {cell.pose.tolist()}")
    cone = _cone(cell)
    # finite elements are at rest if no node violates its law by more than the residual, whatever its area
    most = CONE_N_PER_MM2 if isinstance(cell, QuasiStaticCell) else RESIDUAL_N / float(cell.pads.area.min())
    if not (state.residual_n <= RESIDUAL_N and cone <= most):
        raise ImpossibleStateError(
            f"{cell.scene.name}: residual {state.residual_n:.1e} N, cone violation {cone:.1e} N/mm2 at TCP "
            f"{cell.pose.tolist()}"
        )


def _chunk(work: tuple[int, int, int, str]) -> Tally:
    seed, first, count, tier = work
    tally = Tally()
    for number in range(first, first + count):
        hard_probe(seed, number, tier, tally)
    return tally


def run(count: int, seed: int, tier: str, workers: int, done: int = 0) -> Iterator[Tally]:
    """Tallies of chunks of probes done .. count - 1 in order, from ``workers`` processes (0: one per core)."""
    chunks = [(seed, first, min(CHUNK, count - first), tier) for first in range(done, count, CHUNK)]
    return results(_chunk, chunks, workers, in_order=True)
