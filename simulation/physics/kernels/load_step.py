"""Quasi-static equilibrium of the held object between two pads and two blocks, one load step at a time.

Two solvers, one equilibrium. `newton.direct` lets friction limits follow the pressures within a Newton iteration (a
matrix that is not symmetric) and needs a handful of iterations; where it does not descend, `convex.converge` takes
over: with the limits held, a load step minimises a convex potential (springs, Huber bristles, unilateral contacts),
so semi-smooth Newton with a line search converges from anywhere, and an outer loop renews limits and contact geometry
until that changes nothing (lagged friction, Li et al. 2020). Where the limits jump for ever, `convex.damped` is asked,
and at last `exact.solve`.
What a step leaves for the next: stretches of bristles and contacts, normal forces, poses; all else is made anew.
"""

import math
from typing import Any

from numba import njit

from simulation.physics.kernels import bristles, contact, convex, equilibrium, exact, newton
from simulation.physics.kernels.convex import FREEZE_CONVEX

SETTLED, STALLED, LOST = 0, 1, 2
MAX_DIRECT = 20
EXACT = 0.0


@njit(cache=True)
def _finish(work: Any) -> None:
    """Write the equilibrium into the state: poses, return-mapped stretches, contact forces, wrench."""
    constants, state, trial, rows, slots = work.constants[0], work.state[0], work.trials[0], work.rows, work.slots
    n = constants.unknowns
    for a in range(n):
        trial.grad[a] = 0.0
    equilibrium.rows_assemble(constants, trial, rows, False)
    equilibrium.masses(constants, trial)
    for a in range(6):
        state.wrench[a] = -trial.grad[a]
    state.report[3], state.report[4] = bristles.settle(constants, work.nodes, trial)
    equilibrium.copy_poses(trial, state)
    for i in range(slots.shape[0]):
        slots[i].force = slots[i].slide[0] = slots[i].slide[1] = 0.0
    for i in range(trial.filled):
        row = rows[i]
        gap, s0, s1 = equilibrium.shifted(row, trial.xi, n)
        if gap < 0.0:
            size = math.sqrt(s0 * s0 + s1 * s1) * constants.ratio * row.stiffness
            share = row.bound / size if size > row.bound else 1.0
            slot = slots[row.slot]
            slot.force = -gap * row.stiffness
            slot.slide[0], slot.slide[1] = s0 * share, s1 * share


@njit(cache=True, nogil=True)
def advance(work: Any, pose: Any, target: Any, tol: float, direct: bool, blend: float) -> int:
    """One load step: the hand goes from pose to target (x, y, z mm, yaw and tilt rad). Returns a status code.

    work is a `Workspace`; STALLED and LOST leave its state as it was. blend below 1: the share of a round by which
    friction limits follow where whole rounds do not settle; EXACT: `exact.solve` there instead.
    """
    state = work.state[0]
    value, tries, rounds = math.inf, 0, 0
    equilibrium.begin(work, pose, target)
    if direct:
        value, tries = newton.direct(work, tol, MAX_DIRECT)
    if not value <= tol:
        equilibrium.begin(work, pose, target)
        value, count, rounds = convex.converge(work, tol)
        tries += count
        state.report[0] = value
        if count < 0:
            return LOST
        if not value <= tol or rounds > FREEZE_CONVEX:
            if blend >= 1.0:
                return STALLED
            equilibrium.begin(work, pose, target)
            if blend == EXACT:
                value, count = exact.solve(work, tol)
            else:
                value, count = convex.damped(work, tol, blend)
                contact.hold_rim(work, 0.0)
            tries += count
            if count < 0:
                return LOST
            if not value <= tol:
                return STALLED
    _finish(work)
    state.report[0], state.report[1], state.report[2] = value, tries, rounds
    return SETTLED


@njit(cache=True)
def grip_pressures(work: Any) -> None:
    """Pressures at all nodes for the state's pose in hand and opening."""
    constants, state, trial, nodes = work.constants[0], work.state[0], work.trials[0], work.nodes
    equilibrium.copy_poses(state, trial)
    trial.opening = state.opening
    for j in range(nodes.shape[0]):
        depth, _ = bristles.indentation(constants, nodes[j], trial)
        nodes[j].pressure = constants.kn * nodes[j].stiff * max(depth, 0.0)
