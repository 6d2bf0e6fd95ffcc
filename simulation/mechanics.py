"""Quasi-static equilibrium of the held object between two pads and two blocks, one load step at a time.

With friction limits held, a load step minimises a convex potential (springs, Huber bristles, unilateral contacts)
over the object's six unknowns, and six more for each free block: semi-smooth Newton with a line search. An outer
iteration renews limits and contact geometry from the equilibrium found, until that changes nothing (lagged friction,
Li et al. 2020). Units: mm, N, rad; the unknown is a twist about the TCP in the hand frame, for a block about its
inner top edge in the world.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from simulation import contact, gel
from simulation.contact import Rows
from simulation.linear import apply, apply_t, cholesky_solve, mat, rotation

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

SETTLED, LAGGED, STALLED, LOST = 0, 1, 2, 3
MAX_OUTER, FREEZE_OUTER, MAX_INNER = 40, 30, 60
ARM_MM = 10.0  # turns a torque residual into a force


class Body(NamedTuple):
    """What the object and the blocks are: constants of a scene in mm, N, N/mm."""

    foot: Array
    bottom: float
    weight: float
    mass_height: float
    contact_k: float
    contact_kt: float
    friction: float
    free: int
    block_size: Array
    block_weight: float
    base_k: float
    table_friction: float


class State(NamedTuple):
    """All memory of the cell; arrays are changed in place by `advance`."""

    turn: Array  # [3, 3] object in hand
    place: Array  # [3] mm
    stretch: Array  # [n, 2] mm
    slipped: Ints  # [n] 1 where the last load step slipped
    pressure: Array  # [n] N/mm2
    slide: Array  # [slots + 8, 2] mm, contact stretches, then the blocks' base corners
    force: Array  # [slots + 8] N
    mode: Ints  # [2] TOP or WALL
    block_turn: Array  # [2, 3, 3]
    block: Array  # [2, 3] mm
    wrench: Array  # [6] N, N mm: what blocks and gravity do to the object, at the TCP in the hand frame
    report: Array  # [5] residual N, Newton iterations, outer iterations, slipping nodes, cone violation


@njit(cache=True)
def refresh(
    rows: Rows,
    body: Body,
    state: State,
    turn: Array,
    place: Array,
    hand: Array,
    tcp: Array,
    start_turn: Array,
    start_place: Array,
    block_turn: Array,
    block: Array,
    lagged: bool,
) -> None:
    """Rebuild all contact rows for the current pose.

    Lagged: take friction bounds from the last step, not from the gaps.
    """
    rows.filled[0] = 0
    v = body.foot.shape[0]
    slots = 2 + 2 * v
    world_turn, world_place = mat(hand, turn), apply(hand, place) + tcp
    local, found, index = np.empty((v, 3)), np.empty((2 * v + 4, 4)), np.empty(2 * v + 4, dtype=np.int64)
    up, axes = world_turn[:, 2].copy(), np.empty((2, 3))
    for b in range(2):
        contact.locate(body.foot, body.bottom, world_turn, world_place, block_turn[b], block[b], local)
        up_local = apply_t(block_turn[b], up)
        top = state.mode[b] == contact.TOP
        if top:
            count = contact.clip_top(local, up_local, found, index)
        else:
            count = contact.clip_wall(local, up_local, found, index)
        for i in range(count):
            if found[i, 3] > contact.NEAR_MM:
                continue
            point = apply(block_turn[b], found[i, 0:3].copy()) + block[b]
            if top:
                normal = up if index[i] < 2 else block_turn[b][:, 2].copy()
                axes[0], axes[1] = block_turn[b][:, 0], block_turn[b][:, 1]
            else:
                normal = -block_turn[b][:, 0].copy()
                axes[0], axes[1] = block_turn[b][:, 1], block_turn[b][:, 2]
            before = apply(start_turn, apply_t(world_turn, point - world_place)) + start_place
            anchored = apply(state.block_turn[b], apply_t(block_turn[b], point - block[b])) + state.block[b]
            stiff = body.contact_k if v <= 8 or (top and index[i] < 2) else body.contact_k * 8.0 / v
            contact.add_row(
                rows,
                point,
                normal,
                axes,
                found[i, 3],
                anchored - before,
                stiff,
                b * slots + index[i],
                hand,
                tcp,
                b,
                block[b],
            )
    contacts = rows.filled[0]
    if body.free == 1:
        _add_bases(rows, body, state, block_turn, block, 2 * slots)
    for i in range(rows.filled[0]):
        friction = body.friction if i < contacts else body.table_friction
        slot = rows.slot[i]
        force = state.force[slot] if lagged else max(0.0, -rows.gap[i] * rows.stiffness[i])
        rows.bound[i] = friction * force
        rows.slide[i, 0] += state.slide[slot, 0]
        rows.slide[i, 1] += state.slide[slot, 1]


@njit(cache=True)
def _add_bases(rows: Rows, body: Body, state: State, block_turn: Array, block: Array, first: int) -> None:
    """The four base corners of each free block on the table."""
    corner = np.empty(3)
    for b in range(2):
        for c in range(4):
            corner[0] = body.block_size[0] * (c % 2)
            corner[1] = body.block_size[1] * (0.5 if c < 2 else -0.5)
            corner[2] = -body.block_size[2]
            arm = apply(block_turn[b], corner)
            moved = arm + block[b] - apply(state.block_turn[b], corner) - state.block[b]
            i = rows.filled[0]
            rows.filled[0] = i + 1
            rows.normal[i, :] = 0.0
            rows.tangent[i, :, :] = 0.0
            at = 6 + 6 * b
            rows.normal[i, at + 2] = 1.0
            rows.normal[i, at + 3], rows.normal[i, at + 4] = arm[1], -arm[0]
            rows.tangent[i, 0, at] = 1.0
            rows.tangent[i, 0, at + 4], rows.tangent[i, 0, at + 5] = arm[2], -arm[1]
            rows.tangent[i, 1, at + 1] = 1.0
            rows.tangent[i, 1, at + 3], rows.tangent[i, 1, at + 5] = -arm[2], arm[0]
            rows.gap[i] = arm[2] + block[b, 2] + body.block_size[2]
            rows.slide[i, 0], rows.slide[i, 1] = moved[0], moved[1]
            rows.stiffness[i] = body.base_k
            rows.slot[i] = first + 4 * b + c


@njit(cache=True)
def _row_value(row: Array, xi: Array) -> float:
    total = 0.0
    for a in range(xi.shape[0]):
        total += row[a] * xi[a]
    return total


@njit(cache=True)
def rows_energy(rows: Rows, ratio: float, xi: Array) -> float:
    """Potential of all contacts, N mm, at twist xi since the last refresh. ratio: tangential over normal stiffness."""
    total = 0.0
    for i in range(rows.filled[0]):
        gap = rows.gap[i] + _row_value(rows.normal[i], xi)
        if gap < 0.0:
            total += 0.5 * rows.stiffness[i] * gap * gap
        bound = rows.bound[i]
        if bound > 0.0:
            kt = ratio * rows.stiffness[i]
            s0 = rows.slide[i, 0] + _row_value(rows.tangent[i, 0], xi)
            s1 = rows.slide[i, 1] + _row_value(rows.tangent[i, 1], xi)
            size = math.sqrt(s0 * s0 + s1 * s1)
            total += 0.5 * kt * size * size if kt * size <= bound else bound * (size - 0.5 * bound / kt)
    return total


@njit(cache=True)
def rows_assemble(rows: Rows, ratio: float, xi: Array, grad: Array, hess: Array) -> None:
    """Add gradient [n] and lower half of the Hessian [n, n] of `rows_energy`."""
    n = xi.shape[0]
    for i in range(rows.filled[0]):
        normal = rows.normal[i]
        gap = rows.gap[i] + _row_value(normal, xi)
        if gap < 0.0:
            k = rows.stiffness[i]
            for a in range(n):
                grad[a] += k * gap * normal[a]
                for b in range(a + 1):
                    hess[a, b] += k * normal[a] * normal[b]
        bound = rows.bound[i]
        if bound > 0.0:
            kt = ratio * rows.stiffness[i]
            t0, t1 = rows.tangent[i, 0], rows.tangent[i, 1]
            s0, s1 = rows.slide[i, 0] + _row_value(t0, xi), rows.slide[i, 1] + _row_value(t1, xi)
            size = math.sqrt(s0 * s0 + s1 * s1)
            share, k00, k11, k01 = 1.0, kt, kt, 0.0
            if kt * size > bound:
                share = bound / (kt * size)
                u0, u1 = s0 / size, s1 / size
                k00, k11, k01 = kt * share * u1 * u1, kt * share * u0 * u0, -kt * share * u0 * u1
            for a in range(n):
                grad[a] += kt * share * (s0 * t0[a] + s1 * t1[a])
                left, right = k00 * t0[a] + k01 * t1[a], k01 * t0[a] + k11 * t1[a]
                for b in range(a + 1):
                    hess[a, b] += left * t0[b] + right * t1[b]


@njit(cache=True)
def _weights(body: Body, turn: Array, place: Array, block_turn: Array, block: Array, grad: Array) -> float:
    """Potential of gravity, N mm; adds its gradient."""
    centre = np.array([0.0, 0.0, body.mass_height])
    arm = apply(turn, centre) + place
    grad[2] += body.weight
    grad[3] += arm[1] * body.weight
    grad[4] -= arm[0] * body.weight
    total = body.weight * arm[2]
    if body.free == 1:
        middle = np.array([0.5 * body.block_size[0], 0.0, -0.5 * body.block_size[2]])
        for b in range(2):
            lever = apply(block_turn[b], middle)
            at = 6 + 6 * b
            grad[at + 2] += body.block_weight
            grad[at + 3] += lever[1] * body.block_weight
            grad[at + 4] -= lever[0] * body.block_weight
            total += body.block_weight * (lever[2] + block[b, 2])
    return float(total)


@njit(cache=True)
def _residual(grad: Array) -> float:
    worst = 0.0
    for a in range(grad.shape[0]):
        value = abs(grad[a]) if a % 6 < 3 else abs(grad[a]) / ARM_MM
        if not value < 1e300:
            return math.inf
        worst = max(worst, value)
    return worst


@njit(cache=True)
def _move(twist: Array, scale: float, turn: Array, place: Array, step_turn: Array, step: Array) -> None:
    """Apply a twist about the origin to a pose and to the step's motion, in place."""
    w = rotation(twist[3:6] * scale)
    turn[:, :] = mat(w, turn)
    place[:] = apply(w, place) + twist[0:3] * scale
    step_turn[:, :] = mat(w, step_turn)
    step[:] = apply(w, step) + twist[0:3] * scale


@njit(cache=True)
def _move_blocks(twist: Array, scale: float, block_turn: Array, block: Array) -> None:
    for b in range((twist.shape[0] - 6) // 6):
        at = 6 + 6 * b
        block_turn[b] = mat(rotation(twist[at + 3 : at + 6] * scale), block_turn[b])
        block[b] += twist[at : at + 3] * scale


@njit(cache=True)
def _newton_step(hess: Array, grad: Array) -> Array:
    """Newton direction [n] from the lower half of the Hessian, bounded to 1 mm and 0.05 rad."""
    n = grad.shape[0]
    trace = 0.0
    for a in range(n):
        trace += hess[a, a]
    lift = 1e-12 * trace + 1e-9
    for _ in range(30):
        for a in range(n):
            hess[a, a] += lift
        good, step = cholesky_solve(hess, grad)
        if good:
            break
        lift *= 10.0
    scale = 1.0
    for a in range(n):
        bound = 1.0 if a % 6 < 3 else 0.05
        if abs(step[a]) * scale > bound:
            scale = bound / abs(step[a])
    return -step * scale  # type: ignore[no-any-return]


@njit(cache=True, nogil=True)
def advance(
    pads: gel.Pads, body: Body, opening: float, state: State, rows: Rows, pose: Array, target: Array, tolerance: float
) -> int:
    """One load step: the hand goes from pose to target (x, y, z mm, yaw rad); the state follows. Gives a status code.

    STALLED and LOST leave the state as it was.
    """
    n = rows.normal.shape[1]
    turn, place = state.turn.copy(), state.place.copy()
    step_turn, step = np.eye(3), np.zeros(3)
    block_turn, block = state.block_turn.copy(), state.block.copy()
    hand, tcp = rotation(np.array([0.0, 0.0, target[3]])), target[0:3].copy()
    hand0 = rotation(np.array([0.0, 0.0, pose[3]]))
    start_turn, start_place = mat(hand0, turn), apply(hand0, place) + pose[0:3]
    local = np.empty((body.foot.shape[0], 3))
    for b in range(2):
        contact.locate(body.foot, body.bottom, start_turn, start_place, block_turn[b], block[b], local)
        state.mode[b] = contact.update_mode(local, state.mode[b])
    ratio = body.contact_kt / body.contact_k
    limit = pads.friction * state.pressure
    refresh(rows, body, state, turn, place, hand, tcp, start_turn, start_place, block_turn, block, True)
    xi, total_it, goal = np.zeros(n), 0, 1e-3
    for outer in range(MAX_OUTER):
        value = math.inf
        for inner in range(MAX_INNER):
            grad, hess = np.zeros(n), np.zeros((n, n))
            gel.assemble(pads, opening, turn, place, step_turn, step, state.stretch, limit, grad, hess)
            rows_assemble(rows, ratio, xi, grad, hess)
            _weights(body, turn, place, block_turn, block, grad)
            value = _residual(grad)
            if inner == 0 and outer > 0:
                if value <= tolerance:
                    return _finish(  # type: ignore[no-any-return]
                        pads,
                        opening,
                        state,
                        rows,
                        turn,
                        place,
                        step_turn,
                        step,
                        block_turn,
                        block,
                        limit,
                        ratio,
                        xi,
                        np.array([value, total_it, outer]),
                    )
                goal = max(0.5 * tolerance, min(1e-3, 0.01 * value))
            if value <= goal:
                break
            total_it += 1
            twist = _newton_step(hess, grad)
            scale = _search(
                pads,
                body,
                opening,
                state,
                rows,
                turn,
                place,
                step_turn,
                step,
                block_turn,
                block,
                limit,
                ratio,
                xi,
                twist,
                grad,
            )
            _move(twist, scale, turn, place, step_turn, step)
            _move_blocks(twist, scale, block_turn, block)
            xi += scale * twist
            if not abs(place[0]) + abs(place[1]) + abs(place[2]) < 30.0 or abs(turn[2, 2]) < 0.7:
                return LOST
        if not value <= goal:
            state.report[0] = value
            return STALLED
        if outer < FREEZE_OUTER:
            fresh = np.empty(limit.shape[0])
            gel.pressures(pads, opening, turn, place, fresh)
            blend = 1.0 if outer < 12 else 0.5
            limit = limit + blend * (pads.friction * fresh - limit)
            refresh(rows, body, state, turn, place, hand, tcp, start_turn, start_place, block_turn, block, False)
            xi[:] = 0.0
    return STALLED


@njit(cache=True)
def _search(
    pads: gel.Pads,
    body: Body,
    opening: float,
    state: State,
    rows: Rows,
    turn: Array,
    place: Array,
    step_turn: Array,
    step: Array,
    block_turn: Array,
    block: Array,
    limit: Array,
    ratio: float,
    xi: Array,
    twist: Array,
    grad: Array,
) -> float:
    """Armijo backtracking on the potential along a Newton direction; gives the step length."""
    slope = 0.0
    for a in range(grad.shape[0]):
        slope += grad[a] * twist[a]
    if slope > -1e-9:
        return 1.0
    dummy = np.zeros(grad.shape[0])
    start = gel.energy(pads, opening, turn, place, step_turn, step, state.stretch, limit)
    start += rows_energy(rows, ratio, xi) + _weights(body, turn, place, block_turn, block, dummy)
    scale = 1.0
    for _ in range(25):
        turn1, place1, step_turn1, step1 = turn.copy(), place.copy(), step_turn.copy(), step.copy()
        block_turn1, block1 = block_turn.copy(), block.copy()
        _move(twist, scale, turn1, place1, step_turn1, step1)
        _move_blocks(twist, scale, block_turn1, block1)
        value = gel.energy(pads, opening, turn1, place1, step_turn1, step1, state.stretch, limit)
        value += rows_energy(rows, ratio, xi + scale * twist)
        value += _weights(body, turn1, place1, block_turn1, block1, dummy)
        if value <= start + 1e-4 * scale * slope + 1e-12 * abs(start):
            return scale
        scale *= 0.5
    return scale


@njit(cache=True)
def _finish(
    pads: gel.Pads,
    opening: float,
    state: State,
    rows: Rows,
    turn: Array,
    place: Array,
    step_turn: Array,
    step: Array,
    block_turn: Array,
    block: Array,
    limit: Array,
    ratio: float,
    xi: Array,
    report: Array,
) -> int:
    """Write the equilibrium into the state: poses, return-mapped stretches, contact forces, wrench and report."""
    slipping = gel.settle(pads, opening, step_turn, step, limit, state.stretch, state.slipped)
    gel.pressures(pads, opening, turn, place, state.pressure)
    grad, unused = np.zeros(xi.shape[0]), np.zeros((xi.shape[0], xi.shape[0]))
    gel.assemble(pads, opening, turn, place, np.eye(3), np.zeros(3), state.stretch, limit, grad, unused)
    state.wrench[:] = grad[0:6]
    state.turn[:, :], state.place[:] = turn, place
    state.block_turn[:, :, :], state.block[:, :] = block_turn, block
    old = state.slide.copy()
    state.slide[:, :] = 0.0
    state.force[:] = 0.0
    for i in range(rows.filled[0]):
        gap, slot = rows.gap[i], rows.slot[i]
        if gap >= 0.0 or old.shape[0] == 0:
            continue
        size = math.sqrt(rows.slide[i, 0] ** 2 + rows.slide[i, 1] ** 2)
        kt = ratio * rows.stiffness[i]
        share = rows.bound[i] / (kt * size) if kt * size > rows.bound[i] else 1.0
        state.force[slot] = -gap * rows.stiffness[i]
        state.slide[slot, 0], state.slide[slot, 1] = rows.slide[i, 0] * share, rows.slide[i, 1] * share
    cone = 0.0
    for j in range(limit.shape[0]):
        size = pads.kt * math.sqrt(state.stretch[j, 0] ** 2 + state.stretch[j, 1] ** 2)
        cone = max(cone, size - pads.friction * state.pressure[j])
    state.report[0], state.report[1], state.report[2] = report[0], report[1], report[2]
    state.report[3], state.report[4] = slipping, cone
    return SETTLED if report[2] <= FREEZE_OUTER else LAGGED
