"""Rigid motions: rotations, and how points follow a small motion of their body."""

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def cross_matrix(a: Array) -> Array:
    """The matrix [..., 3, 3] of a x b, acting on b."""
    out = np.zeros((*a.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -a[..., 2], a[..., 1], -a[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = a[..., 2], -a[..., 1], a[..., 0]
    return out


def rotation(vector: Array) -> Array:
    """Rotation matrix [3, 3] of a rotation vector [3], rad (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3) + cross_matrix(vector)
    axis = cross_matrix(vector / angle)
    return np.asarray(np.eye(3) + math.sin(angle) * axis + (1.0 - math.cos(angle)) * axis @ axis)


def rotation_vector(turn: Array) -> Array:
    """Rotation vector [3], rad, of a rotation matrix with an angle under 90 deg."""
    axis = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    sine = float(np.linalg.norm(axis))
    return np.asarray(axis * (math.asin(min(1.0, sine)) / sine if sine > 1e-12 else 1.0))


def about_z(angle_rad: float) -> Array:
    """Rotation matrix [3, 3] about z."""
    return rotation(np.array([0.0, 0.0, angle_rad]))


def lines_of(points: Array) -> Array:
    """Motion of points [n, 3] per unit twist (mm, rad) about the origin: [n, 3, 6]."""
    out = np.zeros((len(points), 3, 6))
    out[:, :, :3], out[:, :, 3:] = np.eye(3), -cross_matrix(points)
    return out
