"""The `layer` tier: pads with coupled nodes, solved by the same equilibrium core as the `bristle` tier.

A layer's surface displacement is u = C t for tractions t (tangential and pressure). Written as a bristle's t / k plus a
rest, u = t / k + d, it is a bristle pad whose anchors are shifted by d. With d held, the bristle core finds pose,
pressures, stick and slip exactly; then d is renewed from C and the tractions until it no longer changes. The fixed
point is the layer's own contact problem (stick: u follows the object; slip: t is at the limit, along the slide;
pressure only where surfaces meet), and its forces balance to the core's residual at every iteration. With k below twice
the layer's smallest stiffness the iteration contracts (Richardson); Anderson's method makes it fast.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from simulation.physics.elastic_layer import Kernel
from simulation.physics.kernels import load_step
from simulation.physics.kernels.records import Records
from simulation.physics.pads import Pad, kernel_of
from simulation.scene.effects import Active
from simulation.scene.scene import Scene

Array = NDArray[np.float64]

SOFTNESS = 1.25  # local over smallest stiffness of the layer; 2 is where Richardson's iteration stops contracting
STIFFER = 3.0  # the same where it does not settle: soft bristles let an object held at a corner buckle in mid-iteration
MAX_ROUNDS, DEPTH = 150, 8
MAX_PATIENT = 1000  # rounds that follow an object have no mixing: some come only 5 % closer a round


class Anderson:
    """Anderson mixing of a fixed-point iteration (Walker and Ni 2011), restarted at twice its best residual."""

    def __init__(self) -> None:
        self._points: list[Array] = []
        self._errors: list[Array] = []
        self._best = np.inf

    def next(self, point: Array, image: Array) -> Array:
        """The next point to try after `point` gave `image`; both of one shape, any unit."""
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


class Relaxation(NamedTuple):
    """One Prony branch: `share` of a held displacement's traction is lost by exp(-t / time_s)."""

    share: float
    time_s: float

    def crept(self, creep: Array, held: Array, duration_s: float) -> Array:
        """Creep after a time at displacements `held`, both mm of one shape. Exact while they are held."""
        goal = self.share * held
        return np.asarray(goal + (creep - goal) * math.exp(-duration_s / self.time_s))


class LayerPads:
    """Anchors and surface of both pads: coupled nodes, creep, and fingers that bend.

    Without a kernel nodes are independent, as in the bristle tier. The displacement of a surface is elastic, plus the
    creep (driven by the change since the grasp, whose force the gripper maintains), plus the finger's own deflection
    along u (total traction over its stiffness). `kernel` may be replaced before the first grasp.
    """

    def __init__(self, scene: Scene, active: Active, kernel: Kernel | None, nodes: Records, constants: Records) -> None:
        gel, grasp = scene.gel, scene.grasp
        self.unsettled, self._settle_mm = False, scene.numerics.settle_mm
        creeps = active.relaxation and gel.relaxation_share > 0.0
        self._relaxation = Relaxation(gel.relaxation_share, gel.relaxation_s) if creeps else None
        bends = active.finger_compliance and grasp.finger_stiffness_n_per_mm > 0.0
        self._bend = 1.0 / grasp.finger_stiffness_n_per_mm if bends else 0.0  # mm/N
        self._shape = (2, gel.node_rows, gel.node_columns)
        self.use(kernel, nodes, constants)

    def use(self, kernel: Kernel | None, nodes: Records, constants: Records) -> None:
        """Use a kernel: its softest wave sets the bristles' stiffness, which affects only the iteration."""
        self.kernel, self._nodes, self._area = kernel, nodes, float(constants["area"][0])
        if kernel is not None:
            self._shape = (2, kernel.grid.rows, kernel.grid.columns)
        self._crown, self._side, self._x = nodes["crown"].copy(), nodes["side"].copy(), nodes["x"].copy()
        self._constants, self._soft = constants, self._softness(constants)  # mm3/N
        constants["kt"], constants["kn"] = 1.0 / self._soft[0], 1.0 / self._soft[2]
        self.surface = np.zeros((*self._shape, 3))  # displacement, mm, finger frame
        self._anchors, self._creep, self._grasped = (np.zeros((*self._shape, 3)) for _ in range(3))
        self._bent = np.zeros(2)  # mm along u

    def _softness(self, constants: Records) -> Array:
        """Compliance of the core's bristles (u, v, normal), mm3/N."""
        fingers = self._bend * self._area * self._shape[1] * self._shape[2]
        if self.kernel is None:
            self._local = 1.0 / float(constants["kt"][0])
            tangential = (self._local + fingers) / SOFTNESS if fingers else self._local
            return np.array([tangential, tangential, 1.0 / float(constants["kn"][0])])
        tangential, normal = self.kernel.largest_mm3_per_n
        return np.array([tangential + fingers, tangential + fingers, normal]) / SOFTNESS

    def _stiffen(self, factor: float) -> None:
        """Make the bristles stiffer by a factor; the tractions at rest stay."""
        self._anchors = self.surface - (self.surface - self._anchors) / factor
        self._nodes["sx"], self._nodes["sz"] = self._nodes["sx"] / factor, self._nodes["sz"] / factor
        self._soft = self._soft / factor
        self._constants["kt"], self._constants["kn"] = 1.0 / self._soft[0], 1.0 / self._soft[2]

    @property
    def relaxes(self) -> bool:
        """Whether time changes anything while the hand stands still."""
        return self._relaxation is not None

    @property
    def stretch(self) -> Array:
        """Tangential displacement of the surface in its finger [n, 2] in mm, hand frame (x, z), for the readout."""
        flat = self._within(self.surface).reshape(-1, 3)
        return np.column_stack([self._side * flat[:, 0], -flat[:, 1]])

    def _within(self, surface: Array) -> Array:
        """A surface in the frame of its finger."""
        if not self._bend:
            return surface
        return np.asarray(surface - self._bent[:, None, None, None] * (1.0, 0.0, 0.0))

    def _tractions(self) -> Array:
        """Tractions [2, rows, columns, 3] in N/mm2, finger frame, that the core left in the nodes."""
        nodes, kt = self._nodes, 1.0 / self._soft[0]
        parts = (kt * self._side * nodes["sx"], -kt * nodes["sz"], nodes["pressure"])
        return np.stack(parts, axis=-1).reshape(*self._shape, 3)

    def _answer(self, tractions: Array) -> tuple[Array, Array]:
        """The surface displacement from tractions, and the part of it that the core's bristles do not model, mm."""
        if self.kernel is not None:
            surface = self.kernel(tractions)
        else:
            stiff = self._nodes["stiff"].reshape(self._shape)
            surface = tractions * (self._local, self._local, self._soft[2])
            surface[..., 2] /= stiff
        if self._bend:
            self._bend_fingers(tractions)
            surface[..., 0] += self._bent[:, None, None]
        if self._relaxation is not None:
            surface += self._creep
        rest = surface - tractions * self._soft
        if self.kernel is None:
            rest[..., 2] = self._creep[..., 2]
        return surface, rest

    def _bend_fingers(self, tractions: Array) -> None:
        """Deflect each finger by the total traction on its pad."""
        self._bent = self._bend * self._area * tractions[..., 0].sum(axis=(1, 2))

    def _place_anchors(self, anchors: Array, before: Array) -> None:
        """Shift every node's bristle: its stretch so far is the surface's, minus the anchor's shift."""
        nodes, rest = self._nodes, (before - anchors).reshape(-1, 3)
        nodes["crown"] = self._crown + anchors[..., 2].ravel()
        nodes["sx"], nodes["sz"] = self._side * rest[:, 0], -rest[:, 1]

    def _settle(self, before: Array, solve: Callable[[], int]) -> int:
        """Iterate the anchors around `solve` until they rest; returns its status, or STALLED if they do not."""
        anchors, mixing, self.unsettled = self._anchors, Anderson(), False
        for _ in range(MAX_ROUNDS):
            self._place_anchors(anchors, before)
            status = solve()
            if status != load_step.SETTLED:
                return status
            surface, fresh = self._answer(self._tractions())
            if float(np.abs(fresh - anchors).max()) <= self._settle_mm:
                self._anchors, self.surface = fresh, surface
                return load_step.SETTLED
            anchors = mixing.next(anchors, fresh)
        self.unsettled = True
        return load_step.STALLED

    def _follow(self, solve: Callable[..., int], rounds: int) -> int:
        """Let the anchors follow the object round by round, each from where the last round left it.

        For an object that snaps over: restarted in each round, it would snap back as soon as the anchors come near.
        """
        anchors, before = self._anchors, self.surface
        for done in range(rounds):
            self._place_anchors(anchors, before)
            status = solve(arrived=done > 0)
            if status != load_step.SETTLED:
                return status
            tractions = self._tractions()
            surface, fresh = self._answer(tractions)
            if float(np.abs(fresh - anchors).max()) <= self._settle_mm:
                self._anchors, self.surface, self.unsettled = fresh, surface, False
                return load_step.SETTLED
            before, anchors = anchors + tractions * self._soft, fresh
        return load_step.STALLED

    def close(self, grip: Callable[[], None]) -> bool:
        """Close the fingers without shear; grip closes bristle pads to the force. False if they do not settle."""
        self._anchors, self._creep = np.zeros_like(self._anchors), np.zeros_like(self._creep)
        self._bent, self._nodes["x"] = np.zeros(2), self._x

        def solve() -> int:
            self._nodes["sx"] = self._nodes["sz"] = 0.0
            grip()
            return load_step.SETTLED

        closed = self._settle(self.surface, solve) == load_step.SETTLED
        self._grasped = self.surface
        return closed

    def advance(
        self, memory: tuple[Records, ...], solve: Callable[..., int], duration_s: float = 0.0, *, patient: bool = False
    ) -> int:
        """One load step; memory: state and slots, restored before each try. Leaves everything unchanged unless SETTLED.

        solve: the core's step; with ``arrived`` the hand has already moved. duration_s: duration of the step; creep
        during it comes before its motion. patient: follow an object that snaps over for as long as it takes.
        """
        kept, nodes = [part.copy() for part in memory], self._nodes.copy()
        own = self._anchors, self._creep, self._bent
        if self._relaxation is not None and duration_s > 0.0:
            self._creep = self._relaxation.crept(self._creep, self._within(self.surface) - self._grasped, duration_s)
            self._anchors = self._anchors + (self._creep - own[1])
        if self._bend:
            self._nodes["x"] = self._x + self._side * np.repeat(self._bent, self._x.size // 2)

        def put_back() -> None:
            for part, old in zip(memory, kept, strict=True):
                part[:] = old

        def again() -> int:
            put_back()
            return solve()

        status = self._settle(self.surface, again)
        if self.unsettled and self.kernel is not None:
            self._stiffen(STIFFER / SOFTNESS)
            status = self._settle(self.surface, again)
            self._stiffen(SOFTNESS / STIFFER)
        if self.unsettled:
            put_back()
            status = self._follow(solve, MAX_PATIENT if patient else MAX_ROUNDS)
        if status != load_step.SETTLED:
            report = memory[0]["report"].copy()
            put_back()
            memory[0]["report"] = report
            self._nodes[:] = nodes
            self._anchors, self._creep, self._bent = own
        return status


def pads_of(scene: Scene, active: Active, pad: Pad, nodes: Records, constants: Records) -> LayerPads | None:
    """Pads with coupling, creep or bending where the scene needs them; None where independent bristles suffice."""
    creeps = active.relaxation and scene.gel.relaxation_share > 0.0
    bends = active.finger_compliance and scene.grasp.finger_stiffness_n_per_mm > 0.0
    if scene.gel.tier == "bristle" and not (creeps or bends):
        return None
    kernel = kernel_of(scene, pad) if scene.gel.tier == "layer" else None
    return LayerPads(scene, active, kernel, nodes, constants)
