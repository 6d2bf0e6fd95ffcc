"""Both pads on the held object: which of their nodes are open, stick or slip, and the resulting equations.

Hand frame: origin at the TCP, x and z along the pads, y across. A node touches the object at a point of the object's
own frame, which is fixed while the node sticks. The object is rigid, so a step's unknowns are its twist and the motion
of the nodes that do not stick: tangential for a slipping node, free for an open one. Forces are those of the object on
the gel. Friction is Coulomb's, |t| <= mu p at each node. Within a step, slip s since its beginning and t obey t =
projection of (t - rho s) onto the disc of radius mu p (Alart and Curnier, 1991).
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from simulation.foreign.elements import Face
from simulation.foreign.rigid import cross_matrix
from simulation.foreign.surface import HeldSurface
from simulation.foreign.yielding import Creep, Springs

Array = NDArray[np.float64]

OPEN, STICK, SLIP = 0, 1, 2
KEPT = 4  # sets of open nodes for which a condensed pad is cached
ROUNDING_MM = 1e-12


@dataclass(slots=True)
class Grip:
    """The object in the hand, and every node of both pads on it; [n] runs over both pads.

    turn [3, 3], place [3]: object frame in the hand frame. on [n, 3]: the nodes in the object frame, mm. status [n].
    """

    turn: Array
    place: Array
    opening: float
    on: Array
    status: NDArray[np.int8]

    def copy(self) -> "Grip":
        return Grip(self.turn.copy(), self.place.copy(), self.opening, self.on.copy(), self.status.copy())

    def take(self, other: "Grip") -> None:
        self.turn, self.place, self.opening = other.turn.copy(), other.place.copy(), other.opening
        self.on, self.status = other.on.copy(), other.status.copy()

    @property
    def points(self) -> Array:
        """The nodes in the hand frame, [n, 3], mm."""
        return self.on @ self.turn.T + self.place


class Planes(NamedTuple):
    """The held surface at each node as a plane of the object frame: n . Y = offset.

    normal (outward), first, second [n, 3]: unit vectors. offset [n], mm.
    """

    normal: Array
    first: Array
    second: Array
    offset: Array

    def gap(self, on: Array) -> Array:
        """Distance of nodes [n, 3] from the surface, outside positive, [n], mm."""
        return np.asarray(np.einsum("ij,ij->i", self.normal, on) - self.offset)

    def slide(self, motion: Array) -> Array:
        """Tangential parts of motions [n, 3]: [n, 2]."""
        first, second = np.einsum("ij,ij->i", self.first, motion), np.einsum("ij,ij->i", self.second, motion)
        return np.stack([first, second], axis=1)


class NodeTerms(NamedTuple):
    """A state's terms at its nodes: forces [n, 3] on the gel, N, hand frame, and the terms of the friction law."""

    forces: Array
    normal: Array  # [n, 3], hand frame
    tangents: Array  # [n, 2, 3]
    pressing: Array  # [n], N
    drag: Array  # [n, 2], N
    trial: Array  # [n, 2], drag minus rho times slip
    limit: Array  # [n], N
    ahead: Array  # [n, 2], unit vectors along trial
    status: NDArray[np.int8]  # that each node should have
    amiss_n: float  # largest violation, in force, of the laws of contact by any node with its present status


class Rows(NamedTuple):
    """The s slipping nodes' equations of one pad, M a + B y = -defect; they move by a [2 s] along their tangents.

    Of its c closed nodes: stiffness [3 c, 3 c] with the open ones released, lines [3 c, k] and forces [3 c]. slipping
    [s]: indices among the nodes of both pads; own [s]: among the closed ones.
    """

    matrix: Array
    coupling: Array
    defect: Array
    stiffness: Array
    lines: Array
    forces: Array
    slipping: NDArray[np.intp]
    own: NDArray[np.intp]
    tangents: Array

    def along(self, rows: Array) -> Array:
        """The part of rows [j, 3 c] along the slips, [j, 2 s]."""
        return _along(rows, self.own, self.tangents)


class Closed(NamedTuple):
    """A pad with force-free open nodes: its c closed nodes, their stiffness and the open nodes' motion.

    open_ [o]; follow [3 o, 3 c]: displacements of open nodes over those of closed ones.
    """

    closed: NDArray[np.intp]
    open_: NDArray[np.intp]
    stiffness: Array
    follow: Array


class Pads:
    """The two gels: stiffness, rest, friction; the methods evaluate and linearise a `Grip`."""

    def __init__(self, face: Face, shear_modulus_n_per_mm2: float, friction: float, crown_mm: float) -> None:
        self.friction, self.count = friction, len(face.area)
        rest, half = face.rest, (float(face.x[-1]), float(face.z[-1]))
        crown = 0.5 * crown_mm * ((rest[:, 0] / half[0]) ** 2 + (rest[:, 2] / half[1]) ** 2)
        self.side = np.repeat([1.0, -1.0], self.count)
        self.rest = np.concatenate([rest, rest])
        self.rest[:, 1] = self.side * np.concatenate([crown, crown])
        self.area = np.concatenate([face.area, face.area])
        # the pad frame's y points out of the gel, which is -y of the hand for the pad at +y: a mirror image
        flip = np.tile([1.0, -1.0, 1.0], self.count)
        own = shear_modulus_n_per_mm2 * face.stiffness
        self.stiffness = (own * np.outer(flip, flip), own)
        self.springs: Springs | None = None
        self.creep: Creep | None = None
        self.rho = np.concatenate([np.diag(own).reshape(-1, 3).mean(axis=1)] * 2)
        self._let_go: tuple[dict[bytes, Closed], ...] = ({}, {})

    def rested(self, opening: float) -> Array:
        """Rest positions of the nodes in the hand frame [n, 3], mm, at an opening of the fingers."""
        out = self.rest.copy()
        out[:, 1] += 0.5 * opening * self.side
        return out

    def stand_on_springs(self, n_per_mm: float) -> None:
        """Let the fingers yield along x, before the first grasp."""
        self.springs = Springs(self.stiffness, n_per_mm)
        self.stiffness = self.springs.stiffness

    def _unforced(self, opening: float) -> Array:
        """Positions of the nodes without forces: rest, and what has crept since the grasp."""
        rested = self.rested(opening)
        return rested if self.creep is None else rested + self.creep.by

    def forces(self, grip: Grip) -> Array:
        """Forces of the object on the nodes, [n, 3], N, hand frame."""
        motion = (grip.points - self._unforced(grip.opening)).reshape(2, -1)
        return np.concatenate([k @ part for k, part in zip(self.stiffness, motion, strict=True)]).reshape(-1, 3)

    def displacement(self, grip: Grip) -> Array:
        """Displacement of the nodes as their finger's camera sees it, [n, 3], mm, hand frame."""
        out = grip.points - self.rested(grip.opening)
        if self.springs:
            out[:, 0] -= self.springs.bent(grip.points - self._unforced(grip.opening))
        return out

    def planes(self, held: HeldSurface, on: Array) -> Planes:
        """The held surface next to nodes [n, 3] in the object frame."""
        height, slope = held.at(self.side, on[:, 0])
        size = np.hypot(1.0, slope)
        nothing = np.zeros_like(size)
        normal = np.stack([-slope / size, self.side / size, nothing], axis=1)
        first = np.stack([1.0 / size, self.side * slope / size, nothing], axis=1)
        second = np.broadcast_to(np.array([0.0, 0.0, 1.0]), on.shape)
        return Planes(normal, first, second, (height - slope * on[:, 0]) / size)

    def evaluate(self, grip: Grip, planes: Planes, start: Array, held_limit: Array | None) -> NodeTerms:
        """Forces at a state and the status that each node should have; held_limit [n] replaces mu p."""
        forces, turn = self.forces(grip), grip.turn.T
        normal = planes.normal @ turn
        tangents = np.stack([planes.first @ turn, planes.second @ turn], axis=1)
        pressing = np.einsum("ij,ij->i", normal, forces)
        drag = np.einsum("ikj,ij->ik", tangents, forces)
        trial = drag - self.rho[:, None] * planes.slide(grip.on - start)
        limit = self.friction * np.maximum(pressing, 0.0) if held_limit is None else held_limit
        size = np.maximum(np.hypot(trial[:, 0], trial[:, 1]), 1e-15)
        closed = np.where(size > limit, SLIP, STICK)
        closed = np.where(pressing < 0.0, OPEN, closed)
        touching = np.where(planes.gap(grip.on) < 0.0, SLIP, OPEN)
        status = np.where(grip.status == OPEN, touching, closed).astype(np.int8)
        ahead = trial / size[:, None]
        amiss = (
            np.maximum(np.abs(forces).max(axis=1), -self.rho * planes.gap(grip.on)),
            np.maximum(np.linalg.norm(drag, axis=1) - limit, -pressing),
            np.maximum(np.maximum(np.abs(drag - limit[:, None] * ahead).max(axis=1), limit - size), -pressing),
        )
        worst = float(np.choose(grip.status, amiss).max())
        return NodeTerms(forces, normal, tangents, pressing, drag, trial, limit, ahead, status, worst)

    def let_go(self, pad: int, opened: NDArray[np.bool_]) -> Closed:
        """A pad with some of its nodes open [n / 2]; cached for the few sets to which a step returns."""
        known, key = self._let_go[pad], opened.tobytes()
        if key not in known:
            while len(known) >= KEPT:
                known.pop(next(iter(known)))
            free, held = _dofs(opened), _dofs(~opened)
            rest: Array = self.stiffness[pad]
            follow: Array = np.zeros((0, len(held)))
            if free.size:
                across = rest[np.ix_(free, held)]
                follow = np.asarray(-np.linalg.solve(rest[np.ix_(free, free)], across), np.float64)
                rest = rest[np.ix_(held, held)] + across.T @ follow
            known[key] = Closed(np.flatnonzero(~opened), np.flatnonzero(opened), rest, follow)
        return known[key]

    def relax(self, grip: Grip) -> None:
        """Put open nodes where no force acts on them."""
        opened = (grip.status == OPEN).reshape(2, -1)
        if not opened.any():
            return
        points, rested = grip.points, self._unforced(grip.opening)
        for pad, mine in enumerate(opened):
            part, first = self.let_go(pad, mine), pad * self.count
            free, held = first + part.open_, first + part.closed
            moved = (part.follow @ (points[held] - rested[held]).ravel()).reshape(-1, 3)
            grip.on[free] = (rested[free] + moved - grip.place) @ grip.turn

    def rows(self, pad: int, grip: Grip, terms: NodeTerms, lines: Array, *, follow: bool, turns: bool) -> Rows:
        """Equations of a pad's slips; lines [n, 3, k]; follow: limits follow the pressures; turns: y is a twist."""
        first = pad * self.count
        part = self.let_go(pad, grip.status[first : first + self.count] == OPEN)
        held = first + part.closed
        own = np.flatnonzero(grip.status[held] == SLIP)
        slipping = held[own]
        tangents, ahead, limit = (each[slipping] for each in (terms.tangents, terms.ahead, terms.limit))
        size = np.maximum(np.linalg.norm(terms.trial[slipping], axis=1), 1e-15)
        stiff = (limit / size)[:, None, None] * (np.eye(2) - ahead[:, :, None] * ahead[:, None, :])
        test = tangents - stiff @ tangents
        if follow:
            test -= self.friction * ahead[:, :, None] * terms.normal[slipping][:, None, :]
        count, closed = len(own), len(held)
        answer = (test @ part.stiffness.reshape(closed, 3, 3 * closed)[own]).reshape(2 * count, 3 * closed)
        matrix, each = _along(answer, own, tangents), np.arange(count)
        matrix.reshape(count, 2, count, 2)[each, :, each] += self.rho[slipping][:, None, None] * stiff
        flat = lines[held].reshape(3 * closed, lines.shape[2])
        coupling = answer @ flat
        if turns:
            coupling[:, 3:6] += (test @ cross_matrix(terms.forces[slipping])).reshape(-1, 3)
        slid = terms.drag[slipping] - limit[:, None] * ahead
        forces = terms.forces[held].ravel()
        return Rows(matrix, coupling, slid.ravel(), part.stiffness, flat, forces, slipping, own, tangents)

    def settle(self, grip: Grip, planes: Planes, start: Array, status: NDArray[np.int8]) -> bool:
        """Set the nodes' status: closed ones lie on the surface, sticking ones where they began the step.

        Returns whether that moved or released any of them.
        """
        before, changed = grip.on.copy(), bool((status != grip.status).any())
        grip.status = status
        stick, closed = status == STICK, status != OPEN
        grip.on[stick] = start[stick]
        grip.on[closed] -= (planes.gap(grip.on)[:, None] * planes.normal)[closed]
        self.relax(grip)
        return changed or bool(np.abs(grip.on - before).max() > ROUNDING_MM)


def _dofs(chosen: NDArray[np.bool_]) -> NDArray[np.intp]:
    return np.flatnonzero(np.repeat(chosen, 3))


def _along(rows: Array, nodes: NDArray[np.intp], tangents: Array) -> Array:
    """The part of rows [j, 3 c] along motions of nodes [s] on their tangents [s, 2, 3]: [j, 2 s]."""
    parts = rows.reshape(len(rows), rows.shape[1] // 3, 3)[:, nodes]
    return np.asarray(
        (parts.swapaxes(0, 1) @ tangents.swapaxes(1, 2)).swapaxes(0, 1).reshape(len(rows), 2 * len(nodes))
    )
