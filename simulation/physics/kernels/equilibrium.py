"""Forces at a trial pose: contact rows and gravity, their potential and gradient, and how a twist moves the trial.

Unknown: a twist of the object about the TCP in the hand frame (mm, rad), then one of each free block about its inner
top edge in the world frame.
"""

import math
from typing import Any

from numba import njit

from simulation.physics.kernels import contact
from simulation.physics.kernels.linear import apply, apply_t, hand_into, product_into, rotation_into, turn_in_place

ARM_MM = 10.0  # turns a torque residual into a force


@njit(cache=True)
def copy_poses(source: Any, into: Any) -> None:
    """Copy the object's pose in hand and both blocks' poses."""
    for a in range(3):
        into.place[a] = source.place[a]
        for c in range(3):
            into.turn[a, c] = source.turn[a, c]
    for b in range(2):
        for a in range(3):
            into.block[b, a] = source.block[b, a]
            for c in range(3):
                into.block_turn[b, a, c] = source.block_turn[b, a, c]


@njit(cache=True)
def copy_trial(source: Any, into: Any) -> None:
    copy_poses(source, into)
    for a in range(source.xi.shape[0]):
        into.xi[a] = source.xi[a]
    for a in range(3):
        into.step[a] = source.step[a]
        for c in range(3):
            into.step_turn[a, c] = source.step_turn[a, c]


@njit(cache=True)
def begin(work: Any, pose: Any, target: Any) -> None:
    """Set the trial to the state, with the hand already at its target (x, y, z mm, yaw and tilt rad)."""
    state, trial, nodes, friction = work.state[0], work.trials[0], work.nodes, work.constants[0].friction
    copy_poses(state, trial)
    trial.opening = state.opening
    for a in range(trial.xi.shape[0]):
        trial.xi[a] = 0.0
    rotation_into(trial.step_turn, 0.0, 0.0, 0.0)
    hand_into(trial.spin, pose[3], pose[4])
    product_into(trial.start_turn, trial.spin, state.turn)
    start = apply(trial.spin, state.place[0], state.place[1], state.place[2])
    hand_into(trial.hand, target[3], target[4])
    for a in range(3):
        trial.step[a], trial.tcp[a] = 0.0, target[a]
        trial.start[a] = trial.world[a] = start[a] + pose[a]
        for c in range(3):
            trial.world_turn[a, c] = trial.start_turn[a, c]
    for b in range(2):
        contact.locate(work, b)
        state.mode[b] = contact.update_mode(work.corner, state.mode[b])
    for j in range(nodes.shape[0]):
        nodes[j].limit = friction * nodes[j].pressure


@njit(cache=True)
def shifted(row: Any, xi: Any, n: int) -> tuple[float, float, float]:
    """Gap and trial stretches of a row at twist xi [n] since the last refresh, mm."""
    gap, s0, s1 = row.gap, row.slide[0], row.slide[1]
    line = row.line
    for a in range(n):
        gap += line[0, a] * xi[a]
        s0 += line[1, a] * xi[a]
        s1 += line[2, a] * xi[a]
    return gap, s0, s1


@njit(cache=True)
def rows_energy(constants: Any, trial: Any, rows: Any) -> float:
    """Potential of all contacts, N mm."""
    total = 0.0
    for i in range(trial.filled):
        row = rows[i]
        gap, s0, s1 = shifted(row, trial.xi, constants.unknowns)
        if gap < 0.0:
            total += 0.5 * row.stiffness * gap * gap
        if row.bound > 0.0:
            kt = constants.ratio * row.stiffness
            size = math.sqrt(s0 * s0 + s1 * s1)
            total += 0.5 * kt * size * size if kt * size <= row.bound else row.bound * (size - 0.5 * row.bound / kt)
    return total


@njit(cache=True)
def _add_slide(row: Any, trial: Any, n: int, kt: float, s0: float, s1: float, follow: float) -> None:
    """A row's friction; follow (1/mm): how its bound grows with the gap's closing, 0 where the bound is held."""
    grad, hess, skew, line = trial.grad, trial.hess, trial.skew, row.line
    size = math.sqrt(s0 * s0 + s1 * s1)
    share, k00, k11, k01 = 1.0, kt, kt, 0.0
    slips = kt * size > row.bound
    if slips:
        share = row.bound / (kt * size)
        u0, u1 = s0 / size, s1 / size
        k00, k11, k01 = kt * share * u1 * u1, kt * share * u0 * u0, -kt * share * u0 * u1
    for a in range(n):
        force = kt * share * (s0 * line[1, a] + s1 * line[2, a])
        grad[a] += force
        left, right = k00 * line[1, a] + k01 * line[2, a], k01 * line[1, a] + k11 * line[2, a]
        for b in range(a + 1):
            hess[a, b] += left * line[1, b] + right * line[2, b]
        if slips and follow != 0.0:
            for b in range(n):
                skew[a, b] += follow * force * line[0, b]


@njit(cache=True)
def rows_assemble(constants: Any, trial: Any, rows: Any, coupled: bool) -> None:
    """Add gradient and lower Hessian of `rows_energy`; coupled: and to skew how the bounds follow the normal forces."""
    n = constants.unknowns
    grad, hess = trial.grad, trial.hess
    for i in range(trial.filled):
        row = rows[i]
        k, line = row.stiffness, row.line
        gap, s0, s1 = shifted(row, trial.xi, n)
        if gap < 0.0:
            for a in range(n):
                grad[a] += k * gap * line[0, a]
                for b in range(a + 1):
                    hess[a, b] += k * line[0, a] * line[0, b]
        if row.bound > 0.0:
            follow = -row.friction * k / row.bound if coupled and gap < 0.0 else 0.0
            _add_slide(row, trial, n, constants.ratio * k, s0, s1, follow)


@njit(cache=True)
def _inertia(constants: Any, trial: Any) -> float:
    """Potential of an implicit Euler step, m / (2 dt^2) |centre - coast|^2, N mm; adds gradient and lower Hessian."""
    grad, hess, turn, height, k = trial.grad, trial.hess, trial.turn, constants.mass_height, constants.inertia
    c = (
        trial.place[0] + turn[0, 2] * height,
        trial.place[1] + turn[1, 2] * height,
        trial.place[2] + turn[2, 2] * height,
    )
    x, y, z = apply(trial.hand, c[0], c[1], c[2])
    tcp, coast = trial.tcp, trial.coast
    x, y, z = apply_t(trial.hand, x + tcp[0] - coast[0], y + tcp[1] - coast[1], z + tcp[2] - coast[2])
    grad[0] += k * x
    grad[1] += k * y
    grad[2] += k * z
    grad[3] += k * (c[1] * z - c[2] * y)
    grad[4] += k * (c[2] * x - c[0] * z)
    grad[5] += k * (c[0] * y - c[1] * x)
    square = c[0] * c[0] + c[1] * c[1] + c[2] * c[2]
    for a in range(3):
        hess[a, a] += k
        hess[3 + a, 3 + a] += k * square
        for b in range(a + 1):
            hess[3 + a, 3 + b] -= k * c[a] * c[b]
        one, two = (a + 1) % 3, (a + 2) % 3
        hess[3 + one, two] -= k * c[a]
        hess[3 + two, one] += k * c[a]
    return float(0.5 * k * (x * x + y * y + z * z))


@njit(cache=True)
def _gravity(constants: Any, trial: Any) -> float:
    """Potential of the held object's weight, N mm; adds its gradient. The vertical is that of the tilted hand."""
    grad, turn, height, weight = trial.grad, trial.turn, constants.mass_height, constants.weight
    up = trial.hand[2, 0], trial.hand[2, 1], trial.hand[2, 2]
    c = (
        trial.place[0] + turn[0, 2] * height,
        trial.place[1] + turn[1, 2] * height,
        trial.place[2] + turn[2, 2] * height,
    )
    grad[0] += up[0] * weight
    grad[1] += up[1] * weight
    grad[2] += up[2] * weight
    grad[3] += (c[1] * up[2] - c[2] * up[1]) * weight
    grad[4] += (c[2] * up[0] - c[0] * up[2]) * weight
    grad[5] += (c[0] * up[1] - c[1] * up[0]) * weight
    return float(weight * (up[0] * c[0] + up[1] * c[1] + up[2] * c[2]))


@njit(cache=True)
def _block_weights(constants: Any, trial: Any) -> float:
    """Potential of the free blocks' weights, N mm; adds its gradient."""
    grad, size, weight, total = trial.grad, constants.block_size, constants.block_weight, 0.0
    for b in range(2):
        x, y, z = apply(trial.block_turn[b], 0.5 * size[0], 0.0, -0.5 * size[2])
        at = 6 + 6 * b
        grad[at + 2] += weight
        grad[at + 3] += y * weight
        grad[at + 4] -= x * weight
        total += weight * (z + trial.block[b, 2])
    return total


@njit(cache=True)
def masses(constants: Any, trial: Any) -> float:
    """Potential of gravity and inertia, N mm, where the scene calls for them; adds gradient and lower Hessian."""
    total = 0.0
    if constants.weight > 0.0:
        total += _gravity(constants, trial)
    if constants.inertia > 0.0:
        total += _inertia(constants, trial)
    if constants.unknowns > 6:
        total += _block_weights(constants, trial)
    return total


@njit(cache=True)
def residual(trial: Any, n: int) -> float:
    """Largest unbalanced force, N; torques count by ARM_MM. Infinite when anything is not finite."""
    worst = 0.0
    for a in range(n):
        value = abs(trial.grad[a]) if a % 6 < 3 else abs(trial.grad[a]) / ARM_MM
        if not value < 1e300:
            return math.inf
        worst = max(worst, value)
    return worst


@njit(cache=True)
def move(trial: Any, n: int, scale: float) -> None:
    """Apply the trial's twist, times scale, to object and blocks."""
    twist, spin = trial.twist, trial.spin
    rotation_into(spin, twist[3] * scale, twist[4] * scale, twist[5] * scale)
    turn_in_place(spin, trial.turn)
    turn_in_place(spin, trial.step_turn)
    place = apply(spin, trial.place[0], trial.place[1], trial.place[2])
    step = apply(spin, trial.step[0], trial.step[1], trial.step[2])
    for a in range(3):
        trial.place[a] = place[a] + twist[a] * scale
        trial.step[a] = step[a] + twist[a] * scale
    for b in range((n - 6) // 6):
        at = 6 + 6 * b
        rotation_into(spin, twist[at + 3] * scale, twist[at + 4] * scale, twist[at + 5] * scale)
        turn_in_place(spin, trial.block_turn[b])
        for a in range(3):
            trial.block[b, a] += twist[at + a] * scale
    for a in range(n):
        trial.xi[a] += twist[a] * scale
