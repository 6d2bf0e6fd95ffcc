"""The `layer` tier: pads whose nodes feel each other, solved by the same equilibrium core as the `bristle` tier.

A layer's surface displacement is u = C t for tractions t (tangential and pressure). Written as a bristle's t / k plus
a rest, u = t / k + d, it is a bristle pad whose anchors are shifted by d: with d held, the bristle core finds pose,
pressures, stick and slip exactly; then d is renewed from C and the tractions until it no longer changes. The fixed
point is the layer's own contact problem (stick: u follows the object; slip: t is at the limit, along the slide;
pressure only where surfaces meet), and its forces balance to the core's residual at every iteration. With k below
twice the layer's smallest stiffness the iteration contracts (Richardson); Anderson's method makes it fast.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from simulation.physics import elastic_layer
from simulation.physics.elastic_layer import Kernel
from simulation.physics.kernels import load_step
from simulation.physics.kernels.records import Records
from simulation.scene.scene import Scene

Array = NDArray[np.float64]

SOFTNESS = 1.25  # local over smallest stiffness of the layer; 2 is where Richardson's iteration stops contracting
TOLERANCE_MM = 1e-6
MAX_ROUNDS, DEPTH = 150, 8


class Anderson:
    """Anderson mixing of a fixed-point iteration (Walker and Ni 2011), begun again whenever it loses ground."""

    def __init__(self) -> None:
        self._points: list[Array] = []
        self._errors: list[Array] = []
        self._best = np.inf

    def next(self, point: Array, image: Array) -> Array:
        """The point to try after `image` came out at `point`; both of one shape, any unit."""
        error = (image - point).ravel()
        size = float(np.linalg.norm(error))
        if size > 2.0 * self._best:
            self._points, self._errors = [], []
        self._best = min(self._best, size)
        self._points, self._errors = [*self._points, image.ravel()][-DEPTH:], [*self._errors, error][-DEPTH:]
        if len(self._errors) == 1:
            return image
        steps = np.stack([error - other for other in self._errors[:-1]])
        gram = steps @ steps.T
        gram[np.diag_indices_from(gram)] += 1e-14 * np.trace(gram) + 1e-300
        shares = np.linalg.solve(gram, steps @ error)
        moves = np.stack([self._points[-1] - other for other in self._points[:-1]])
        return np.asarray((self._points[-1] - shares @ moves).reshape(point.shape))


class LayerPads:
    """Both pads' anchors and surface. `kernel` may be replaced (half-space) before the first grasp."""

    def __init__(self, scene: Scene, nodes: Records, constants: Records) -> None:
        pads, sensor = scene.gel, scene.sensor
        rows, columns = pads.node_rows, pads.node_columns
        grid = elastic_layer.Grid(rows, columns, sensor.gel_height_mm / rows, sensor.gel_width_mm / columns)
        poisson = elastic_layer.poisson_ratio(pads.normal_ratio)
        kernel = elastic_layer.bonded_layer(grid, pads.thickness_mm, pads.shear_modulus_n_per_mm2, poisson)
        self.rounds, self.unsettled = 0, False
        self.use(kernel, nodes, constants)

    def use(self, kernel: Kernel, nodes: Records, constants: Records) -> None:
        """Take a kernel: its softest wave sets the bristles' stiffness, which only steers the iteration."""
        self.kernel, self._nodes = kernel, nodes
        self._shape = (2, kernel.grid.rows, kernel.grid.columns)
        self._crown, self._side = nodes["crown"].copy(), nodes["side"].copy()
        tangential, normal = kernel.largest_mm3_per_n
        self._soft = np.array([tangential, tangential, normal]) / SOFTNESS  # mm3/N
        constants["kt"], constants["kn"] = 1.0 / self._soft[0], 1.0 / self._soft[2]
        self.surface = np.zeros((*self._shape, 3))  # displacement, mm, finger frame
        self._anchors = np.zeros((*self._shape, 3))

    @property
    def stretch(self) -> Array:
        """Tangential displacement of the surface [n, 2] in mm, hand frame (x, z), as the readout takes it."""
        flat = self.surface.reshape(-1, 3)
        return np.column_stack([self._side * flat[:, 0], -flat[:, 1]])

    def _tractions(self) -> Array:
        """Tractions [2, rows, columns, 3] in N/mm2, finger frame, that the core left in the nodes."""
        nodes, kt = self._nodes, 1.0 / self._soft[0]
        parts = (kt * self._side * nodes["sx"], -kt * nodes["sz"], nodes["pressure"])
        return np.stack(parts, axis=-1).reshape(*self._shape, 3)

    def _place_anchors(self, anchors: Array, before: Array) -> None:
        """Shift every node's bristle: its stretch so far is the surface's, less the anchor's shift."""
        nodes, rest = self._nodes, (before - anchors).reshape(-1, 3)
        nodes["crown"] = self._crown + anchors[..., 2].ravel()
        nodes["sx"], nodes["sz"] = self._side * rest[:, 0], -rest[:, 1]

    def _settle(self, before: Array, solve: Callable[[], int]) -> int:
        """Iterate the anchors around `solve` until they rest; gives its status, or STALLED where they do not."""
        anchors, mixing, self.unsettled = self._anchors, Anderson(), False
        for _ in range(MAX_ROUNDS):
            self.rounds += 1
            self._place_anchors(anchors, before)
            status = solve()
            if status != load_step.SETTLED:
                return status
            tractions = self._tractions()
            surface = self.kernel(tractions)
            fresh = surface - tractions * self._soft
            if float(np.abs(fresh - anchors).max()) <= TOLERANCE_MM:
                self._anchors, self.surface = fresh, surface
                return load_step.SETTLED
            anchors = mixing.next(anchors, fresh)
        self.unsettled = True
        return load_step.STALLED

    def close(self, grip: Callable[[], None]) -> bool:
        """Close the fingers without shear; grip closes bristle pads to the force. False where they do not settle."""
        self._anchors[:] = 0.0

        def solve() -> int:
            self._nodes["sx"] = self._nodes["sz"] = 0.0
            grip()
            return load_step.SETTLED

        return self._settle(self.surface, solve) == load_step.SETTLED

    def advance(self, memory: tuple[Records, ...], solve: Callable[[], int]) -> int:
        """One load step; memory: state and slots, put back before each try. Leaves all as it was unless SETTLED."""
        kept, nodes = [part.copy() for part in memory], self._nodes.copy()

        def again() -> int:
            for part, old in zip(memory, kept, strict=True):
                part[:] = old
            return solve()

        status = self._settle(self.surface, again)
        if status != load_step.SETTLED:
            report = memory[0]["report"].copy()
            for part, old in zip(memory, kept, strict=True):
                part[:] = old
            memory[0]["report"] = report
            self._nodes[:] = nodes
        return status


def pads_of(scene: Scene, nodes: Records, constants: Records) -> LayerPads | None:
    """What a scene's tier needs beyond the bristles; None for the bristle tier."""
    return LayerPads(scene, nodes, constants) if scene.gel.tier == "layer" else None
