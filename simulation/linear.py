"""Small dense linear algebra for compiled kernels: 3-vectors, rotations, Cholesky.

No LAPACK, so no scipy at run time.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


@njit(cache=True)
def rotation(w: Array) -> Array:
    """Rotation matrix [3, 3] of a rotation vector [3] in rad (Rodrigues' formula)."""
    angle = math.sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    if angle < 1e-8:
        a, b = 1.0 - angle * angle / 6.0, 0.5
    else:
        a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / (angle * angle)
    out = np.empty((3, 3))
    c = math.cos(angle)
    x, y, z = w[0], w[1], w[2]
    out[0, 0], out[0, 1], out[0, 2] = c + b * x * x, b * x * y - a * z, b * x * z + a * y
    out[1, 0], out[1, 1], out[1, 2] = b * x * y + a * z, c + b * y * y, b * y * z - a * x
    out[2, 0], out[2, 1], out[2, 2] = b * x * z - a * y, b * y * z + a * x, c + b * z * z
    return out


@njit(cache=True)
def mat(a: Array, b: Array) -> Array:
    """Product of two [3, 3] matrices."""
    out = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]
    return out


@njit(cache=True)
def apply(a: Array, x: Array) -> Array:
    """Matrix [3, 3] times vector [3]."""
    out = np.empty(3)
    for i in range(3):
        out[i] = a[i, 0] * x[0] + a[i, 1] * x[1] + a[i, 2] * x[2]
    return out


@njit(cache=True)
def apply_t(a: Array, x: Array) -> Array:
    """Transposed matrix [3, 3] times vector [3]."""
    out = np.empty(3)
    for i in range(3):
        out[i] = a[0, i] * x[0] + a[1, i] * x[1] + a[2, i] * x[2]
    return out


@njit(cache=True)
def cross(a: Array, b: Array) -> Array:
    """Cross product of two vectors [3]."""
    out = np.empty(3)
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]
    return out


@njit(cache=True)
def dot(a: Array, b: Array) -> float:
    """Scalar product of two vectors [3]."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]  # type: ignore[no-any-return]


@njit(cache=True)
def cholesky_solve(matrix: Array, rhs: Array) -> tuple[bool, Array]:
    """Solve a symmetric positive definite system [n, n]; False when the matrix is not positive definite."""
    n = rhs.shape[0]
    low = np.zeros((n, n))
    out = rhs.copy()
    for i in range(n):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= low[i, k] * low[j, k]
            if i == j:
                if not total > 0.0:
                    return False, out
                low[i, i] = math.sqrt(total)
            else:
                low[i, j] = total / low[j, j]
    for i in range(n):
        for k in range(i):
            out[i] -= low[i, k] * out[k]
        out[i] /= low[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            out[i] -= low[k, i] * out[k]
        out[i] /= low[i, i]
    return True, out
