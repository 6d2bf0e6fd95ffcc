"""Both pads on the held object: which of their nodes are open, stick or slip, and the equations that follow.

Hand frame: origin at the TCP, x and z along the pads, y across. A node touches the object at a point of the object's
own frame, which stays where it is while the node sticks. The object is rigid, so that a step's unknowns are its twist
and the motion of those nodes only that do not stick: tangential for a slipping node, free for an open one. Forces are
those that the object exerts on the gel. Friction is Coulomb's, |t| <= mu p at each node; within a step, slip s since
its beginning and t obey t = projection of (t - rho s) onto the disc of radius mu p (Alart and Curnier, 1991).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from simulation.foreign.elements import Face
from simulation.foreign.surface import HeldSurface

Array = NDArray[np.float64]

OPEN, STICK, SLIP = 0, 1, 2


@dataclass(slots=True)
class Grip:
    """Where the object is in the hand, and where every node of both pads is on it; [n] runs over both pads.

    turn [3, 3], place [3]: object frame in the hand frame. on [n, 3]: the nodes in the object frame, mm. status [n].
    """

    turn: Array
    place: Array
    opening: float
    on: Array
    status: NDArray[np.int8]

    def copy(self) -> Grip:
        """Independent of this one."""
        return Grip(self.turn.copy(), self.place.copy(), self.opening, self.on.copy(), self.status.copy())

    def take(self, other: Grip) -> None:
        """Become a copy of another one."""
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
        """How far nodes [n, 3] are outside, [n], mm."""
        return np.asarray(np.einsum("ij,ij->i", self.normal, on) - self.offset)

    def slide(self, motion: Array) -> Array:
        """Tangential parts of motions [n, 3]: [n, 2]."""
        first, second = np.einsum("ij,ij->i", self.first, motion), np.einsum("ij,ij->i", self.second, motion)
        return np.stack([first, second], axis=1)


class Judged(NamedTuple):
    """What a state asks of its nodes: forces [n, 3] on the gel, N, hand frame, and by node the friction law's terms."""

    forces: Array
    normal: Array  # [n, 3], hand frame
    tangents: Array  # [n, 2, 3]
    pressing: Array  # [n], N
    drag: Array  # [n, 2], N
    trial: Array  # [n, 2], drag less rho times slip
    limit: Array  # [n], N
    ahead: Array  # [n, 2], unit vectors along trial
    status: NDArray[np.int8]  # that each node should have
    amiss_n: float  # how far, in force, any node is from the laws of contact with the status that it has


class Rows(NamedTuple):
    """The free nodes' equations of one pad, M a + B y = -defect; they move by columns' a."""

    matrix: Array
    coupling: Array
    defect: Array
    columns: csr_array


class Pads:
    """The two gels: stiffness, rest, friction; the methods judge and linearise a `Grip`."""

    def __init__(self, face: Face, shear_modulus_n_per_mm2: float, friction: float, crown_mm: float) -> None:
        self.friction, self.count = friction, len(face.area)
        rest, half = face.rest, (float(face.x[-1]), float(face.z[-1]))
        crown = 0.5 * crown_mm * ((rest[:, 0] / half[0]) ** 2 + (rest[:, 2] / half[1]) ** 2)
        self.side = np.repeat([1.0, -1.0], self.count)
        self.rest = np.concatenate([rest, rest])
        self.rest[:, 1] = self.side * np.concatenate([crown, crown])
        self.area = np.concatenate([face.area, face.area])
        # the pad frame's y leads out of the gel, which is -y of the hand for the pad at +y: a mirror image
        flip = np.tile([1.0, -1.0, 1.0], self.count)
        own = shear_modulus_n_per_mm2 * face.stiffness
        self.stiffness = (own * np.outer(flip, flip), own)
        self.rho = np.concatenate([np.diag(own).reshape(-1, 3).mean(axis=1)] * 2)

    def rested(self, opening: float) -> Array:
        """Nodes at rest in the hand frame [n, 3], mm, with the fingers at an opening."""
        out = self.rest.copy()
        out[:, 1] += 0.5 * opening * self.side
        return out

    def forces(self, grip: Grip) -> Array:
        """What the object does to the nodes, [n, 3], N, hand frame."""
        motion = (grip.points - self.rested(grip.opening)).reshape(2, -1)
        return np.concatenate([k @ part for k, part in zip(self.stiffness, motion, strict=True)]).reshape(-1, 3)

    def planes(self, held: HeldSurface, on: Array) -> Planes:
        """The held surface next to nodes [n, 3] in the object frame."""
        height, slope = held.at(self.side, on[:, 0])
        size = np.hypot(1.0, slope)
        nothing = np.zeros_like(size)
        normal = np.stack([-slope / size, self.side / size, nothing], axis=1)
        first = np.stack([1.0 / size, self.side * slope / size, nothing], axis=1)
        second = np.broadcast_to(np.array([0.0, 0.0, 1.0]), on.shape)
        return Planes(normal, first, second, (height - slope * on[:, 0]) / size)

    def judge(self, grip: Grip, planes: Planes, start: Array, held_limit: Array | None) -> Judged:
        """Forces at a state and the status that each node should have; held_limit [n] in place of mu p."""
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
        return Judged(forces, normal, tangents, pressing, drag, trial, limit, ahead, status, worst)

    def rows(self, pad: int, grip: Grip, judged: Judged, lines: Array, *, follow: bool, turns: bool) -> Rows:
        """Equations of a pad's free nodes; lines [n, 3, k], limits that follow the pressures, y that is a twist."""
        part = slice(pad * self.count, (pad + 1) * self.count)
        status, forces = grip.status[part], judged.forces[part]
        opened, slipping = np.flatnonzero(status == OPEN), np.flatnonzero(status == SLIP)
        tangents, ahead, limit = (each[part][slipping] for each in (judged.tangents, judged.ahead, judged.limit))
        size = np.maximum(np.linalg.norm(judged.trial[part][slipping], axis=1), 1e-15)
        stiff = (limit / size)[:, None, None] * (np.eye(2) - ahead[:, :, None] * ahead[:, None, :])
        test = tangents - stiff @ tangents
        if follow:
            test -= self.friction * ahead[:, :, None] * judged.normal[part][slipping][:, None, :]
        node = np.concatenate([np.repeat(opened, 3), np.repeat(slipping, 2)])
        unit = np.tile(np.eye(3), (len(opened), 1))
        left, right = np.concatenate([unit, test.reshape(-1, 3)]), np.concatenate([unit, tangents.reshape(-1, 3)])
        tests, columns = _spread(node, left, self.count), _spread(node, right, self.count)
        answer = tests @ self.stiffness[pad]
        matrix = (columns @ answer.T).T
        first = 3 * len(opened) + 2 * np.arange(len(slipping))
        own = self.rho[part][slipping][:, None, None] * stiff
        for a in range(2):
            for b in range(2):
                matrix[first + a, first + b] += own[:, a, b]
        coupling = answer @ lines[part].reshape(3 * self.count, -1)
        if turns:
            coupling[3 * len(opened) :, 3:6] += np.cross(left, forces[node])[3 * len(opened) :]
        slid = judged.drag[part][slipping] - limit[:, None] * ahead
        return Rows(matrix, coupling, np.concatenate([forces[opened].ravel(), slid.ravel()]), columns)

    def settle(self, grip: Grip, planes: Planes, start: Array, status: NDArray[np.int8]) -> None:
        """Give nodes their status: closed ones lie on the surface, sticking ones where they began the step."""
        grip.status = status
        stick, closed = status == STICK, status != OPEN
        grip.on[stick] = start[stick]
        grip.on[closed] -= (planes.gap(grip.on)[:, None] * planes.normal)[closed]


def _spread(node: NDArray[np.intp], vectors: Array, count: int) -> csr_array:
    """Rows [m] of vectors [m, 3], each at its node's three columns of 3 count."""
    columns = (3 * node[:, None] + np.arange(3)).ravel()
    return csr_array((vectors.ravel(), columns, 3 * np.arange(len(node) + 1)), shape=(len(node), 3 * count))
