"""Small dense linear algebra for compiled kernels. No LAPACK, so no scipy at run time; vectors are three scalars."""

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Vector = tuple[float, float, float]


@njit(cache=True)
def rotation_into(out: Any, x: float, y: float, z: float) -> None:
    """Rotation matrix [3, 3] of a rotation vector in rad (Rodrigues' formula)."""
    angle = math.sqrt(x * x + y * y + z * z)
    if angle < 1e-8:
        a, b = 1.0 - angle * angle / 6.0, 0.5
    else:
        a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / (angle * angle)
    c = math.cos(angle)
    out[0, 0], out[0, 1], out[0, 2] = c + b * x * x, b * x * y - a * z, b * x * z + a * y
    out[1, 0], out[1, 1], out[1, 2] = b * x * y + a * z, c + b * y * y, b * y * z - a * x
    out[2, 0], out[2, 1], out[2, 2] = b * x * z - a * y, b * y * z + a * x, c + b * z * z


@njit(cache=True)
def hand_into(out: Any, yaw: float, tilt: float) -> None:
    """Rotation matrix [3, 3] of a hand turned by yaw about z, and tilted by tilt about its own y, both in rad."""
    cy, sy, ct, st = math.cos(yaw), math.sin(yaw), math.cos(tilt), math.sin(tilt)
    out[0, 0], out[0, 1], out[0, 2] = cy * ct, -sy, cy * st
    out[1, 0], out[1, 1], out[1, 2] = sy * ct, cy, sy * st
    out[2, 0], out[2, 1], out[2, 2] = -st, 0.0, ct


@njit(cache=True)
def product_into(out: Any, a: Any, b: Any) -> None:
    """Product of two [3, 3] matrices; out must be neither of them."""
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]


@njit(cache=True)
def turn_in_place(w: Any, a: Any) -> None:
    """Turn a [3, 3] into w a."""
    for j in range(3):
        x, y, z = a[0, j], a[1, j], a[2, j]
        for i in range(3):
            a[i, j] = w[i, 0] * x + w[i, 1] * y + w[i, 2] * z


@njit(cache=True)
def apply(a: Any, x: float, y: float, z: float) -> Vector:
    """Matrix [3, 3] times vector."""
    return (
        a[0, 0] * x + a[0, 1] * y + a[0, 2] * z,
        a[1, 0] * x + a[1, 1] * y + a[1, 2] * z,
        a[2, 0] * x + a[2, 1] * y + a[2, 2] * z,
    )


@njit(cache=True)
def apply_t(a: Any, x: float, y: float, z: float) -> Vector:
    """Transposed matrix [3, 3] times vector."""
    return (
        a[0, 0] * x + a[1, 0] * y + a[2, 0] * z,
        a[0, 1] * x + a[1, 1] * y + a[2, 1] * z,
        a[0, 2] * x + a[1, 2] * y + a[2, 2] * z,
    )


@njit(cache=True)
def cholesky_solve(a: Any, x: Any, n: int) -> bool:
    """Solve a x = x in place from the lower half of a [n, n], which is overwritten; False when it is not definite."""
    for i in range(n):
        for j in range(i + 1):
            total = a[i, j]
            for k in range(j):
                total -= a[i, k] * a[j, k]
            if i > j:
                a[i, j] = total / a[j, j]
            elif total > 0.0:
                a[i, i] = math.sqrt(total)
            else:
                return False
    for i in range(n):
        for k in range(i):
            x[i] -= a[i, k] * x[k]
        x[i] /= a[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            x[i] -= a[k, i] * x[k]
        x[i] /= a[i, i]
    return True


@njit(cache=True)
def lu_solve(a: Any, x: Any, n: int) -> bool:
    """Solve a x = x in place by elimination with row pivots; a [n, n] is overwritten; False when it is singular."""
    for i in range(n):
        pivot = i
        for k in range(i + 1, n):
            if abs(a[k, i]) > abs(a[pivot, i]):
                pivot = k
        if not abs(a[pivot, i]) > 1e-12:
            return False
        for j in range(n):
            a[i, j], a[pivot, j] = a[pivot, j], a[i, j]
        x[i], x[pivot] = x[pivot], x[i]
        for k in range(i + 1, n):
            share = a[k, i] / a[i, i]
            for j in range(i + 1, n):
                a[k, j] -= share * a[i, j]
            x[k] -= share * x[i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            x[i] -= a[i, k] * x[k]
        x[i] /= a[i, i]
    return True
