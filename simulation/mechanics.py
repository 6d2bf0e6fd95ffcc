"""Quasi-static equilibrium of the held object between two pads and two blocks, one load step at a time.

Two solvers, one equilibrium. `_direct` lets friction limits follow the pressures within a Newton iteration (a matrix
that is not symmetric) and needs a handful of iterations; where it does not descend, `_convex` takes over: with the
limits held, a load step minimises a convex potential (springs, Huber bristles, unilateral contacts), so semi-smooth
Newton with a line search converges from anywhere, and an outer loop renews limits and contact geometry until that
changes nothing (lagged friction, Li et al. 2020).
"""

from __future__ import annotations

import math
from typing import Any

from numba import njit

from simulation import contact, equilibrium, gel
from simulation.linear import cholesky_solve, lu_solve

SETTLED, STALLED, LOST = 0, 1, 2
MAX_DIRECT, MAX_CONVEX, FREEZE_CONVEX, MAX_INNER = 20, 40, 30, 60
FAR_IN_HAND_MM = 30.0


@njit(cache=True)
def _forces(constants: Any, trial: Any, rows: Any, nodes: Any, coupled: bool) -> float:
    """Unbalanced force, N, at the trial pose, with gradient, lower Hessian and coupling."""
    n = constants.unknowns
    for a in range(n):
        trial.grad[a] = 0.0
        for b in range(n):
            trial.hess[a, b] = trial.skew[a, b] = 0.0
    gel.assemble(constants, nodes, trial, coupled)
    equilibrium.rows_assemble(constants, trial, rows, coupled)
    equilibrium.masses(constants, trial)
    return float(equilibrium.residual(trial, n))


@njit(cache=True)
def _bounded(trial: Any, n: int) -> float:
    """Scale that keeps the twist within 1 mm and 0.05 rad."""
    scale = 1.0
    for a in range(n):
        bound = 1.0 if a % 6 < 3 else 0.05
        if abs(trial.twist[a]) * scale > bound:
            scale = bound / abs(trial.twist[a])
    return scale


@njit(cache=True)
def _gone(trial: Any) -> bool:
    place = trial.place
    return not (abs(place[0]) + abs(place[1]) + abs(place[2]) < FAR_IN_HAND_MM and trial.turn[2, 2] > 0.7)


@njit(cache=True)
def _coupled_step(trial: Any, n: int) -> bool:
    """Newton twist of the coupled system; False when it has none."""
    lift = 0.0
    for a in range(n):
        lift += trial.hess[a, a]
    for a in range(n):
        trial.twist[a] = -trial.grad[a]
        for b in range(n):
            trial.full[a, b] = trial.skew[a, b] + (trial.hess[a, b] if a >= b else trial.hess[b, a])
        trial.full[a, a] += 1e-13 * lift + 1e-9
    return bool(lu_solve(trial.full, trial.twist, n))


@njit(cache=True)
def _direct(
    constants: Any,
    state: Any,
    trial: Any,
    spare: Any,
    rows: Any,
    slots: Any,
    nodes: Any,
    foot: Any,
    corner: Any,
    tol: float,
) -> tuple[float, int]:
    """Coupled Newton; gives the residual, N, and the iterations. Leaves the equilibrium in trial when it converged."""
    n = constants.unknowns
    contact.refresh(constants, state, trial, rows, slots, foot, corner, False)
    value = _forces(constants, trial, rows, nodes, True)
    for i in range(MAX_DIRECT):
        if value <= tol:
            return value, i
        if not _coupled_step(trial, n):
            return math.inf, i
        scale, before = _bounded(trial, n), value
        for a in range(n):
            spare.twist[a] = trial.twist[a]
        equilibrium.copy_trial(trial, spare)
        for _ in range(5):
            equilibrium.move(trial, n, scale)
            contact.refresh(constants, state, trial, rows, slots, foot, corner, False)
            value = _forces(constants, trial, rows, nodes, True)
            if value < before * (1.0 - 0.1 * scale) or (i < 3 and value < 10.0 * before):
                break
            equilibrium.copy_trial(spare, trial)
            scale *= 0.35
            value = math.inf
        if not value < math.inf or _gone(trial):
            return math.inf, i
    return value, MAX_DIRECT


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
    scale, slope = _bounded(trial, n), 0.0
    for a in range(n):
        trial.twist[a] *= scale
        slope += trial.twist[a] * trial.grad[a]
    return slope


@njit(cache=True)
def _potential(constants: Any, trial: Any, rows: Any, nodes: Any) -> float:
    total = gel.energy(constants, nodes, trial) + equilibrium.rows_energy(constants, trial, rows)
    return float(total + equilibrium.masses(constants, trial))


@njit(cache=True)
def _descend(constants: Any, trial: Any, spare: Any, rows: Any, nodes: Any, slope: float) -> None:
    """Move the trial along its twist as far as Armijo's rule on the potential allows."""
    n, scale = constants.unknowns, 1.0
    if slope > -1e-9:
        equilibrium.move(trial, n, scale)
        return
    start = _potential(constants, trial, rows, nodes)
    equilibrium.copy_trial(trial, spare)
    for _ in range(25):
        equilibrium.move(trial, n, scale)
        value = _potential(constants, trial, rows, nodes)
        if value <= start + 1e-4 * scale * slope + 1e-12 * abs(start):
            return
        equilibrium.copy_trial(spare, trial)
        scale *= 0.5
    equilibrium.move(trial, n, scale)


@njit(cache=True)
def _convex(
    constants: Any,
    state: Any,
    trial: Any,
    spare: Any,
    rows: Any,
    slots: Any,
    nodes: Any,
    foot: Any,
    corner: Any,
    tol: float,
) -> tuple[float, int, int]:
    """Lagged friction; gives the residual, N, all iterations (-1: the object left the hand) and the rounds."""
    count, goal, value, exact = 0, 1e-3, math.inf, False
    contact.refresh(constants, state, trial, rows, slots, foot, corner, True)
    for outer in range(MAX_CONVEX):
        for inner in range(MAX_INNER):
            value = _forces(constants, trial, rows, nodes, False)
            if inner == 0 and outer > 0:
                if value <= tol and (exact or outer > FREEZE_CONVEX):
                    return value, count, outer
                goal = max(0.5 * tol, min(1e-3, 0.01 * value))
            if value <= goal:
                break
            count += 1
            slope = _convex_step(trial, constants.unknowns)
            _descend(constants, trial, spare, rows, nodes, slope)
            if _gone(trial):
                return math.inf, -1, outer
        if not value <= goal:
            return value, count, outer
        if outer < FREEZE_CONVEX:
            exact = outer < 12 or value <= 1e3 * tol
            gel.renew_limits(constants, nodes, trial, 1.0 if exact else 0.5)
            contact.refresh(constants, state, trial, rows, slots, foot, corner, False)
    return value, count, MAX_CONVEX


@njit(cache=True)
def _finish(constants: Any, state: Any, trial: Any, rows: Any, slots: Any, nodes: Any) -> None:
    """Write the equilibrium into the state: poses, return-mapped stretches, contact forces, wrench."""
    n = constants.unknowns
    for a in range(n):
        trial.grad[a] = 0.0
    equilibrium.rows_assemble(constants, trial, rows, False)
    equilibrium.masses(constants, trial)
    for a in range(6):
        state.wrench[a] = -trial.grad[a]
    state.report[3], state.report[4] = gel.settle(constants, nodes, trial)
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
def advance(
    constants_: Any, state_: Any, trials: Any, rows: Any, slots: Any, nodes: Any, foot: Any, corner: Any,
    pose: Any, target: Any, tol: float, direct: bool,
) -> int:  # fmt: skip
    """One load step: the hand goes from pose to target (x, y, z mm, yaw rad); the state follows. Gives a status code.

    Records come as arrays [1], trials as [2]. STALLED and LOST leave the state as it was.
    """
    constants, state, trial, spare = constants_[0], state_[0], trials[0], trials[1]
    value, tries, rounds = math.inf, 0, 0
    equilibrium.begin(constants, state, trial, nodes, foot, corner, pose, target)
    if direct:
        value, tries = _direct(constants, state, trial, spare, rows, slots, nodes, foot, corner, tol)
    if not value <= tol:
        equilibrium.begin(constants, state, trial, nodes, foot, corner, pose, target)
        value, count, rounds = _convex(constants, state, trial, spare, rows, slots, nodes, foot, corner, tol)
        tries += count
        state.report[0] = value
        if count < 0:
            return LOST
        if not value <= tol or rounds > FREEZE_CONVEX:
            return STALLED
    _finish(constants, state, trial, rows, slots, nodes)
    state.report[0], state.report[1], state.report[2] = value, tries, rounds
    return SETTLED


@njit(cache=True)
def grip_pressures(constants_: Any, state_: Any, trials: Any, nodes: Any) -> None:
    """Pressures at all nodes for the state's pose in hand and opening."""
    constants, state, trial = constants_[0], state_[0], trials[0]
    equilibrium.copy_poses(state, trial)
    trial.opening = state.opening
    for j in range(nodes.shape[0]):
        depth, _ = gel.indentation(constants, nodes[j], trial)
        nodes[j].pressure = constants.kn * max(depth, 0.0)
