"""Lagged friction: with the limits held, a load step minimises a convex potential, and rounds renew the limits.

Semi-smooth Newton with a line search converges from anywhere within a round. Rounds take the new limits whole, which
is fast; where whole steps jump from side to side (stick and slip each leading to the other), `damped` takes a part and
has the coupled Newton end what it began.
Within a round normals and tangents of the contacts are held as the limits are; the last round's are the equilibrium's.
"""

import math
from typing import Any

from numba import njit

from simulation.physics.kernels import bristles, contact, equilibrium
from simulation.physics.kernels.linear import cholesky_solve
from simulation.physics.kernels.newton import bounded, direct, forces, gone

MAX_CONVEX, FREEZE_CONVEX, MAX_INNER, MAX_DAMPED = 40, 30, 60, 1000
FINISH_EVERY, MAX_FINISH = 10, 80
"""Damped rounds between two attempts of the coupled Newton to end them, and its iterations: it comes closer by a third
only where contact frames turn with the object."""
RIM_MM = 0.1


@njit(cache=True)
def _convex_step(trial: Any, n: int) -> float:
    """Descent twist from the lower half of a positive semi-definite Hessian, bounded; gives the slope along it."""
    lift = 1e-9
    for a in range(n):
        lift += 1e-12 * trial.hess[a, a]
    for _ in range(30):
        for a in range(n):
            trial.twist[a] = -trial.grad[a]
            for b in range(a + 1):
                trial.full[a, b] = trial.hess[a, b]
            trial.full[a, a] += lift
        if cholesky_solve(trial.full, trial.twist, n):
            break
        lift *= 10.0
    scale, slope = bounded(trial, n), 0.0
    for a in range(n):
        trial.twist[a] *= scale
        slope += trial.twist[a] * trial.grad[a]
    return slope


@njit(cache=True)
def _potential(work: Any) -> float:
    constants, trial = work.constants[0], work.trials[0]
    total = bristles.energy(constants, work.nodes, trial) + equilibrium.rows_energy(constants, trial, work.rows)
    return float(total + equilibrium.masses(constants, trial))


@njit(cache=True)
def _descend(work: Any, slope: float) -> None:
    """Move the trial along its twist as far as Armijo's rule on the potential allows."""
    trial, spare = work.trials[0], work.trials[1]
    n, scale = work.constants[0].unknowns, 1.0
    if slope > -1e-9:
        equilibrium.move(trial, n, scale)
        return
    start = _potential(work)
    equilibrium.copy_trial(trial, spare)
    for _ in range(25):
        equilibrium.move(trial, n, scale)
        value = _potential(work)
        if value <= start + 1e-4 * scale * slope + 1e-12 * abs(start):
            return
        equilibrium.copy_trial(spare, trial)
        scale *= 0.5
    equilibrium.move(trial, n, scale)


@njit(cache=True)
def converge(work: Any, tol: float) -> tuple[float, int, int]:
    """Lagged friction; gives the residual, N, all iterations (-1: the object left the hand) and the rounds."""
    constants, trial = work.constants[0], work.trials[0]
    count, goal, value, exact = 0, 1e-3, math.inf, False
    contact.refresh(work, True)
    for outer in range(MAX_CONVEX):
        for inner in range(MAX_INNER):
            value = forces(work, False)
            if inner == 0 and outer > 0:
                if value <= tol and (exact or outer > FREEZE_CONVEX):
                    return value, count, outer
                goal = max(0.5 * tol, min(1e-3, 0.01 * value))
            if value <= goal:
                break
            count += 1
            slope = _convex_step(trial, constants.unknowns)
            _descend(work, slope)
            if gone(trial):
                return math.inf, -1, outer
        if not value <= goal:
            return value, count, outer
        if outer < FREEZE_CONVEX:
            exact = outer < 12 or value <= 1e3 * tol
            bristles.renew_limits(constants, work.nodes, trial, 1.0 if exact else 0.5)
            contact.refresh(work, False)
    return value, count, MAX_CONVEX


@njit(cache=True)
def _renew_damped(work: Any, blend: float) -> None:
    """Move all friction limits a part of the way to what pressures and gaps say; rows were just refreshed."""
    trial = work.trials[0]
    bristles.renew_limits(work.constants[0], work.nodes, trial, blend)
    for i in range(trial.filled):
        row = work.rows[i]
        slot = work.slots[row.slot]
        slot.guess += blend * (row.bound - slot.guess)
        row.bound = slot.guess


@njit(cache=True)
def _begin_damped(work: Any) -> None:
    """Rows at the trial pose, and the limits that they had as the first guess of the new ones."""
    trial, rows, slots = work.trials[0], work.rows, work.slots
    contact.refresh(work, True)
    contact.hold_rim(work, RIM_MM)
    contact.refresh(work, True)
    for i in range(slots.shape[0]):
        slots[i].guess = 0.0
    for i in range(trial.filled):
        slots[rows[i].slot].guess = rows[i].bound


@njit(cache=True)
def _finish(work: Any, tol: float) -> tuple[float, int]:
    """Coupled Newton from where damped rounds stand; gives its residual and iterations. Puts all back if it fails."""
    trial, kept, nodes, rows = work.trials[0], work.trials[2], work.nodes, work.rows
    equilibrium.copy_trial(trial, kept)
    for j in range(nodes.shape[0]):
        nodes[j].guess = nodes[j].limit
    value, count = direct(work, tol, MAX_FINISH)
    if value <= tol:
        return value, count
    equilibrium.copy_trial(kept, trial)
    contact.refresh(work, False)
    for i in range(trial.filled):
        rows[i].bound = work.slots[rows[i].slot].guess
    for j in range(nodes.shape[0]):
        nodes[j].limit = nodes[j].guess
    return math.inf, count


@njit(cache=True)
def damped(work: Any, tol: float, blend: float) -> tuple[float, int]:
    """Lagged friction again, its limits moved by blend a round: goes where whole steps jump from side to side.

    The way to the end is long at such steps (a part wedged between both walls comes 1 to 2 % closer a round), so every
    few rounds the coupled Newton tries to end it. Contacts at a block's very edge count as they do at the start, see
    `contact.hold_rim`.

    Gives the residual, N, and all iterations (-1: the object left the hand).
    """
    trial, unknowns = work.trials[0], work.constants[0].unknowns
    count, value = 0, math.inf
    _begin_damped(work)
    for outer in range(MAX_DAMPED):
        goal = 1e-3
        for inner in range(MAX_INNER):
            value = forces(work, False)
            if inner == 0 and outer > 0:
                if value <= tol * blend:
                    return value / blend, count
                goal = max(0.1 * tol * blend, min(1e-3, 0.01 * value))
            if value <= goal:
                break
            count += 1
            slope = _convex_step(trial, unknowns)
            _descend(work, slope)
            if gone(trial):
                return math.inf, -1
        if not value <= goal:
            return math.inf, count
        contact.refresh(work, False)
        _renew_damped(work, blend)
        if outer % FINISH_EVERY == FINISH_EVERY - 1:
            value, tries = _finish(work, tol)
            count += tries
            if value <= tol:
                return value, count
    return math.inf, count
