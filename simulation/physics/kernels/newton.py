"""Forces at a trial pose, and the coupled Newton iteration: friction limits follow the pressures at once.

A handful of iterations where it descends; where it does not, `convex` takes over. Contact rows are refreshed
at every trial pose, so that normals and tangents are those of the equilibrium, not of the step before.
"""

import math
from typing import Any

from numba import njit

from simulation.physics.kernels import bristles, contact, equilibrium
from simulation.physics.kernels.linear import lu_solve

FAR_IN_HAND_MM = 30.0


@njit(cache=True)
def forces(work: Any, coupled: bool) -> float:
    """Unbalanced force, N, at the trial pose, with gradient, lower Hessian and coupling."""
    constants, trial = work.constants[0], work.trials[0]
    n = constants.unknowns
    for a in range(n):
        trial.grad[a] = 0.0
        for b in range(n):
            trial.hess[a, b] = trial.skew[a, b] = 0.0
    bristles.assemble(constants, work.nodes, trial, coupled)
    equilibrium.rows_assemble(constants, trial, work.rows, coupled)
    equilibrium.masses(constants, trial)
    return float(equilibrium.residual(trial, n))


@njit(cache=True)
def bounded(trial: Any, n: int) -> float:
    """Scale that keeps the twist within 1 mm and 0.05 rad."""
    scale = 1.0
    for a in range(n):
        bound = 1.0 if a % 6 < 3 else 0.05
        if abs(trial.twist[a]) * scale > bound:
            scale = bound / abs(trial.twist[a])
    return scale


@njit(cache=True)
def gone(trial: Any) -> bool:
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
def direct(work: Any, tol: float, most: int) -> tuple[float, int]:
    """Coupled Newton; gives the residual, N, and how many of `most` iterations it took.

    Leaves the equilibrium in trial when it converged.
    """
    trial, spare, n = work.trials[0], work.trials[1], work.constants[0].unknowns
    contact.refresh(work, False)
    value = forces(work, True)
    for i in range(most):
        if value <= tol:
            return value, i
        if not _coupled_step(trial, n):
            return math.inf, i
        scale, before = bounded(trial, n), value
        for a in range(n):
            spare.twist[a] = trial.twist[a]
        equilibrium.copy_trial(trial, spare)
        for _ in range(5):
            equilibrium.move(trial, n, scale)
            contact.refresh(work, False)
            value = forces(work, True)
            if value < before * (1.0 - 0.1 * scale) or (i < 3 and value < 10.0 * before):
                break
            equilibrium.copy_trial(spare, trial)
            scale *= 0.35
            value = math.inf
        if not value < math.inf or gone(trial):
            return math.inf, i
    return value, most
