"""The coupled Newton iteration with the whole matrix: also how contacts move over object and blocks.

Where the object's side is nearly parallel to a block's edge, the corner that bears the load runs along the edge many
times as far as the object moves, and its gap and slide with it. `newton.direct` and `convex.converge` hold contacts
while they step and find them elsewhere afterwards: each step leads further away from an equilibrium that is there.
Differences of the forces between nearby poses know all of it. They cost 2 n evaluations an iteration, so this comes
last.
"""

import math
from typing import Any

from numba import njit

from simulation.physics.kernels import contact, equilibrium
from simulation.physics.kernels.linear import lu_solve
from simulation.physics.kernels.newton import bounded, forces, gone

MAX_EXACT, MAX_HALVINGS = 40, 12
NUDGE_MM, NUDGE_RAD = 1e-7, 1e-8  # far below the travel to the next kink, far above rounding


@njit(cache=True)
def _unbalanced(work: Any) -> float:
    """Unbalanced force, N, at the trial pose, with its contacts and friction limits."""
    contact.refresh(work, False)
    return float(forces(work, True))


@njit(cache=True)
def _differentiate(work: Any) -> None:
    """The matrix of the coupled system at the trial pose, by central differences; the spare holds that pose."""
    trial, spare, n = work.trials[0], work.trials[1], work.constants[0].unknowns
    for b in range(n):
        nudge = NUDGE_MM if b % 6 < 3 else NUDGE_RAD
        for a in range(n):
            trial.full[a, b] = trial.twist[a] = 0.0
        trial.twist[b] = nudge
        for sign in (1.0, -1.0):
            equilibrium.move(trial, n, sign)
            _unbalanced(work)
            equilibrium.copy_trial(spare, trial)
            for a in range(n):
                trial.full[a, b] += 0.5 * sign * trial.grad[a] / nudge


@njit(cache=True)
def _step(work: Any, before: float) -> float:
    """Move the trial along its Newton twist as far as its unbalanced force, N, falls; infinite where it does not."""
    trial, spare, n = work.trials[0], work.trials[1], work.constants[0].unknowns
    equilibrium.copy_trial(trial, spare)
    _differentiate(work)
    _unbalanced(work)
    for a in range(n):
        trial.twist[a] = -trial.grad[a]
    if not lu_solve(trial.full, trial.twist, n):
        return math.inf
    scale = bounded(trial, n)
    for _ in range(MAX_HALVINGS):
        equilibrium.move(trial, n, scale)
        value = _unbalanced(work)
        if value < before * (1.0 - 0.05 * scale):
            return float(value)
        equilibrium.copy_trial(spare, trial)
        scale *= 0.5
    return math.inf


@njit(cache=True)
def solve(work: Any, tol: float) -> tuple[float, int]:
    """Exact Newton; gives the residual, N, and its iterations. Leaves the equilibrium in trial when it converged."""
    trial = work.trials[0]
    value = _unbalanced(work)
    for i in range(MAX_EXACT):
        if value <= tol:
            return value, i
        value = _step(work, value)
        if not value < math.inf or gone(trial):
            return math.inf, i
    return value, MAX_EXACT
