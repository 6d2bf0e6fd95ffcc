"""One load step: semi-smooth Newton on the pads' nodes and all rigid motions at once.

With the friction limits held, a step's equations are those of a convex problem: elastic energy, limits times slips, no
penetration. `solve` first lets the limits follow the pressures within Newton's iteration, which needs a handful of
iterations. If that does not converge, it solves the convex problem repeatedly, with limits renewed from its pressures
(Haslinger's fixed point). If that does not settle either, it reports failure.
"""

from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from simulation.foreign.pads import SLIP, STICK, Grip, NodeTerms, Pads, Planes
from simulation.foreign.surface import HeldSurface

Array = NDArray[np.float64]

FOLLOWING, HOLDING, ROUNDS = 20, 60, 40
CURVED = 8  # iterations in which the held surface's planes are renewed; at a kink they would jump for ever
RENEWALS = 6  # times that nodes may have slid on to other planes by the end of the iteration
NEARLY_N = 1e-4  # when a round changes the limits by less, Newton finishes
BALANCING, BALANCED, SEARCHING, OVERSHOT = 8, 1e-2, 5, 0.5
STUCK = 1e-5  # below this relative change per iteration the residual has stalled
LONGEST_MM = 0.5  # longest motion of one iteration: beyond it, the linearised equations have no meaning
ARM_MM = 10.0  # turns a torque residual into a force, a rotation into a length


class Push(NamedTuple):
    """Generalised force on the rigid motions [k] (N, N mm), and a function for its derivative [k, k] in that state.

    The function's argument is whether to be careful: to use a slope that never vanishes, for sliding friction.
    """

    force: Array
    slope: Callable[[bool], Array]


class Drive(Protocol):
    """The rigid motions y [k] that a step solves for, with all their loads except the pads'."""

    count: int  # k
    turns: bool  # whether the first six are the held object's twist about the TCP

    def push(self, grip: Grip) -> Push:
        """The push in a state."""

    def lines(self, grip: Grip, points: Array) -> Array:
        """Motion of the pads' nodes [n, 3] with the first j motions, relative to the gel's rest: [n, 3, j]."""

    def move(self, grip: Grip, motion: Array) -> None:
        """Apply a motion [k] to the grip and to all other moving bodies."""

    def weight(self, force: Array) -> float:
        """Largest of unbalanced forces [k] in N."""

    def reach(self, motion: Array) -> float:
        """About how far a motion [k] moves anything, mm."""

    def memory(self) -> tuple[Array, ...]:
        """Copies of everything that `move` changes, except the grip."""

    def recall(self, memory: tuple[Array, ...]) -> None:
        """Restore a result of `memory`."""


class Step:
    """A load step of a grip under a drive. Where `solve` returns infinity, it leaves the grip at no equilibrium."""

    def __init__(self, pads: Pads, held: HeldSurface, drive: Drive, grip: Grip) -> None:
        self.pads, self.held, self.drive, self.grip, self.start = pads, held, drive, grip, grip.on.copy()
        self.planes: Planes = pads.planes(held, grip.on)
        self._guessed = False
        self._before, self._memory = grip.copy(), drive.memory()

    def guess(self, on: Array, motion: Array) -> None:
        """Start the search from node motions on [n, 3] and rigid motions motion [k]."""
        self._guessed = True
        self.grip.on += on
        self.drive.move(self.grip, motion)

    def undo(self) -> None:
        self.drive.recall(self._memory)
        self.grip.take(self._before)

    def solve(self, tolerance_n: float) -> float:
        """Solve for the end of the step. Returns the residual, N; infinite if there is no solution."""
        residual = self.run(tolerance_n, None, FOLLOWING) if self._guessed else np.inf
        for follow in (True, False):
            if residual <= tolerance_n:
                break
            self._afresh()
            residual = self.run(tolerance_n, None, FOLLOWING) if follow else self._by_rounds(tolerance_n)
        return residual

    def _afresh(self) -> None:
        """Restart from the beginning of the step with all touching nodes held: an elastic predictor."""
        self.undo()
        self.grip.status[self.grip.status == SLIP] = STICK
        self.planes = self.pads.planes(self.held, self.grip.on)

    def _by_rounds(self, tolerance_n: float) -> float:
        """The convex problem with limits held, repeatedly, each time with the limits from the last pressures."""
        limit = self.pads.friction * np.maximum(self._pressing(), 0.0)
        for _ in range(ROUNDS):
            if self.run(tolerance_n, limit, HOLDING) > tolerance_n:
                return np.inf
            fresh = self.pads.friction * np.maximum(self._pressing(), 0.0)
            if float(np.abs(fresh - limit).max()) <= NEARLY_N:
                return self.run(tolerance_n, None, FOLLOWING)
            limit = fresh
        return np.inf

    def _pressing(self) -> Array:
        return self.pads.evaluate(self.grip, self.planes, self.start, None).pressing

    def run(self, tolerance_n: float, limit: Array | None, most: int) -> float:
        """Newton's iteration with limits held [n] or following (None). The residual, N; infinite: not at rest."""
        try:
            for _ in range(RENEWALS):
                residual = self._run(tolerance_n, limit, most)
                if residual > tolerance_n or self._on_the_surface(tolerance_n, limit):
                    return residual
        except np.linalg.LinAlgError:
            pass
        return np.inf

    def _on_the_surface(self, tolerance_n: float, limit: Array | None) -> bool:
        """Whether the nodes are also at rest on the planes next to where they came to lie."""
        planes = self.pads.planes(self.held, self.grip.on)
        return self.pads.evaluate(self.grip, planes, self.start, limit).amiss_n <= tolerance_n

    def _run(self, tolerance_n: float, limit: Array | None, most: int) -> float:
        pads, grip, drive = self.pads, self.grip, self.drive
        pads.settle(grip, self.planes, self.start, grip.status)
        residual = np.inf
        for i in range(most):
            if i < CURVED:
                self.planes = pads.planes(self.held, grip.on)
            terms = pads.evaluate(grip, self.planes, self.start, limit)
            lines, push = drive.lines(grip, grip.points), drive.push(grip)
            left = push.force.copy()
            left[: lines.shape[2]] -= terms.forces.ravel() @ lines.reshape(3 * len(grip.on), -1)
            before, residual = residual, max(drive.weight(left), terms.amiss_n)
            if residual <= tolerance_n or not np.isfinite(residual):
                return residual
            if abs(residual - before) < STUCK * residual:
                break
            if ((terms.status != grip.status).any() or i < CURVED) and pads.settle(
                grip, self.planes, self.start, terms.status
            ):
                terms = pads.evaluate(grip, self.planes, self.start, limit)
            self._improve(terms, lines, push, follow=limit is None)
        return np.inf

    def _improve(self, terms: NodeTerms, lines: Array, push: Push, *, follow: bool) -> None:
        """Newton's step of the pads, with the slipping nodes eliminated, which leaves a linear term for the drive."""
        pads, grip, drive, k = self.pads, self.grip, self.drive, lines.shape[2]
        matrix, force, answers = np.zeros((drive.count, drive.count)), np.zeros(drive.count), []
        for pad in range(2):
            rows = pads.rows(pad, grip, terms, lines, follow=follow, turns=drive.turns)
            back = -(rows.stiffness @ rows.lines).T
            if drive.turns:
                back[3:6] += _torque_rows(rows.forces.reshape(-1, 3))
            answer = np.linalg.solve(rows.matrix, np.column_stack([rows.defect, rows.coupling]))
            reach = rows.along(back)
            matrix[:k, :k] += back @ rows.lines - reach @ answer[:, 1:]
            force[:k] -= rows.forces @ rows.lines + reach @ answer[:, 0]
            answers.append((rows, answer))
        motion = self._balance(push, force, matrix)[:k]
        moved = np.zeros_like(grip.on)
        for rows, answer in answers:
            slid = -(answer[:, 0] + answer[:, 1:] @ motion).reshape(-1, 2)
            moved[rows.slipping] = np.einsum("sak,sa->sk", rows.tangents, slid) @ grip.turn
        grip.on += min(1.0, LONGEST_MM / max(1e-300, float(np.abs(moved).max()))) * moved
        pads.relax(grip)

    def _balance(self, push: Push, force: Array, matrix: Array) -> Array:
        """Move the drive to where its push balances the pads' force + matrix y; returns the motion y [k].

        This has few unknowns and stiff contacts: Newton's iteration with a line search and, where sliding contacts
        leave nothing to hold on to, one that treats their friction as springs of its size.
        """
        drive, grip = self.drive, self.grip
        goal = BALANCED * drive.weight(push.force + force)
        at, memory = grip.copy(), drive.memory()
        for careful, most in ((False, BALANCING), (True, 4 * BALANCING)):
            total = np.zeros_like(force)
            for _ in range(most):
                rest = force + matrix @ total
                left = push.force + rest
                if drive.weight(left) <= goal:
                    return total
                motion: Array = np.asarray(np.linalg.solve(push.slope(careful) + matrix, -left), np.float64)
                motion = motion * min(1.0, LONGEST_MM / max(1e-300, drive.reach(motion)))
                share, push = self._share_of(motion, left, rest, matrix)
                total = total + share * motion
            if not careful:
                drive.recall(memory)
                grip.take(at)
                push = drive.push(grip)
        return total

    def _share_of(self, motion: Array, left: Array, rest: Array, matrix: Array) -> tuple[float, Push]:
        """Move by the share of a motion that does not raise the residual, else by all of it; returns the push there."""
        drive, grip = self.drive, self.grip
        at, memory = self.grip.copy(), drive.memory()
        work, before, share = float(left @ motion), drive.weight(left), 1.0
        for _ in range(SEARCHING):
            drive.move(grip, share * motion)
            push = drive.push(grip)
            now = push.force + rest + matrix @ (share * motion)
            still = float(now @ motion)
            if abs(still) <= OVERSHOT * abs(work) or drive.weight(now) <= (1.0 - 0.1 * share) * before:
                return share, push
            drive.recall(memory)
            grip.take(at)
            share *= max(0.1, min(0.7, work / (work - still))) if work > 0.0 > still else 0.5
        drive.move(grip, motion)
        return 1.0, drive.push(grip)


def _torque_rows(forces: Array) -> Array:
    """Change of the torque of forces [n, 3] on the object as their points move: [3, 3 n]."""
    out = np.zeros((3, *forces.shape))
    out[0, :, 1], out[0, :, 2] = -forces[:, 2], forces[:, 1]
    out[1, :, 0], out[1, :, 2] = forces[:, 2], -forces[:, 0]
    out[2, :, 0], out[2, :, 1] = -forces[:, 1], forces[:, 0]
    return out.reshape(3, -1)
