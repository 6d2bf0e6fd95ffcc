"""Kinematics of the IRB 1600-6/1.45: joints for the feedback of the emulated controller, poses for joint guidance.

Geometry from ABB's data sheet: shoulder 486.5 mm up and 150 mm out, upper arm 700 mm, forearm 600 mm (reach 1450 mm),
wrist centre to flange 65 mm, spherical wrist. Zero: upper arm upright, forearm level, flange z along base x.
"""

import math

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]

SHOULDER_OUT_MM, SHOULDER_UP_MM = 150.0, 486.5
UPPER_ARM_MM, FOREARM_MM, FLANGE_MM = 700.0, 600.0, 65.0


class ReachError(ValueError):
    """A pose that the arm cannot take."""


def _turn_x(angle: float) -> Matrix:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def _turn_y(angle: float) -> Matrix:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def _turn_z(angle: float) -> Matrix:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


_FLANGE_FRAME = _turn_y(math.pi / 2.0)  # tool0's z points along the forearm's x


def forward(joints_deg: tuple[float, ...]) -> tuple[Matrix, Matrix]:
    """Position [3] (mm) and rotation [3, 3] of tool0 in the base frame for six joint angles in degrees."""
    j1, j2, j3, j4, j5, j6 = (math.radians(j) for j in joints_deg)
    out = SHOULDER_OUT_MM + UPPER_ARM_MM * math.sin(j2) + FOREARM_MM * math.cos(j2 + j3)
    up = SHOULDER_UP_MM + UPPER_ARM_MM * math.cos(j2) - FOREARM_MM * math.sin(j2 + j3)
    wrist = np.array([out * math.cos(j1), out * math.sin(j1), up])
    rotation = _turn_z(j1) @ _turn_y(j2 + j3) @ _turn_x(j4) @ _turn_y(j5) @ _turn_x(j6)
    return wrist + FLANGE_MM * rotation[:, 0], rotation @ _FLANGE_FRAME


def inverse(position_mm: Matrix, rotation: Matrix) -> tuple[float, ...]:
    """Six joint angles in degrees (elbow up, wrist unflipped) of a tool0 pose in the base frame; raise ReachError."""
    arm = rotation @ _FLANGE_FRAME.T
    wrist = position_mm - FLANGE_MM * arm[:, 0]
    j1 = math.atan2(wrist[1], wrist[0])
    out, up = math.hypot(wrist[0], wrist[1]) - SHOULDER_OUT_MM, wrist[2] - SHOULDER_UP_MM
    sine = (UPPER_ARM_MM**2 + FOREARM_MM**2 - out**2 - up**2) / (2.0 * UPPER_ARM_MM * FOREARM_MM)
    if not -1.0 <= sine <= 1.0:
        raise ReachError(f"wrist at {out + SHOULDER_OUT_MM:.0f} mm out, {up:.0f} mm up is out of the arm's reach")
    j3 = math.asin(sine)
    along, across = UPPER_ARM_MM - FOREARM_MM * sine, FOREARM_MM * math.cos(j3)
    j2 = math.atan2(along * out - across * up, across * out + along * up)
    bend = (_turn_z(j1) @ _turn_y(j2 + j3)).T @ arm
    sine5 = math.hypot(bend[1, 0], bend[2, 0])
    j5 = math.atan2(sine5, bend[0, 0])
    if sine5 < 1e-9:  # straight wrist: only j4 + j6 is defined
        j4, j6 = 0.0, math.atan2(bend[2, 1], bend[1, 1])
    else:
        j4, j6 = math.atan2(bend[1, 0], -bend[2, 0]), math.atan2(bend[0, 1], bend[0, 2])
    return tuple(math.degrees(j) for j in (j1, j2, j3, j4, j5, j6))
