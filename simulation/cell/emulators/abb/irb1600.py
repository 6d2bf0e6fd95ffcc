"""Kinematics of the IRB 1600-6/1.45: joint angles for the feedback of the emulated controller.

Geometry from ABB's data sheet: shoulder 486.5 mm up and 150 mm out, upper arm 700 mm, forearm 600 mm (reach 1450 mm),
wrist centre to flange 65 mm, spherical wrist. Zero: upper arm upright, forearm level, flange z along base x.
"""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Matrix = NDArray[np.float64]

SHOULDER_OUT_MM, SHOULDER_UP_MM = 150.0, 486.5
UPPER_ARM_MM, FOREARM_MM, FLANGE_MM = 700.0, 600.0, 65.0
FLANGE_FRAME: Matrix = Rotation.from_euler("y", 90.0, degrees=True).as_matrix()
"""tool0 in the frame of the forearm: its z points along the forearm's x."""


class ReachError(ValueError):
    """A pose that the arm cannot reach."""


def inverse(position_mm: Matrix, rotation: Matrix) -> tuple[float, ...]:
    """Six joint angles in degrees (elbow up, wrist unflipped) of a tool0 pose in the base frame; raise ReachError."""
    arm = rotation @ FLANGE_FRAME.T
    wrist = position_mm - FLANGE_MM * arm[:, 0]
    j1 = math.atan2(wrist[1], wrist[0])
    out, up = math.hypot(wrist[0], wrist[1]) - SHOULDER_OUT_MM, wrist[2] - SHOULDER_UP_MM
    sine = (UPPER_ARM_MM**2 + FOREARM_MM**2 - out**2 - up**2) / (2.0 * UPPER_ARM_MM * FOREARM_MM)
    if not -1.0 <= sine <= 1.0:
        raise ReachError(f"wrist at {out + SHOULDER_OUT_MM:.0f} mm out, {up:.0f} mm up is out of the arm's reach")
    j3 = math.asin(sine)
    along, across = UPPER_ARM_MM - FOREARM_MM * sine, FOREARM_MM * math.cos(j3)
    j2 = math.atan2(along * out - across * up, across * out + along * up)
    bend = Rotation.from_euler("ZY", [j1, j2 + j3]).as_matrix().T @ arm
    sine5 = math.hypot(bend[1, 0], bend[2, 0])
    j5 = math.atan2(sine5, bend[0, 0])
    if sine5 < 1e-9:  # straight wrist: only j4 + j6 is defined
        j4, j6 = 0.0, math.atan2(bend[2, 1], bend[1, 1])
    else:
        j4, j6 = math.atan2(bend[1, 0], -bend[2, 0]), math.atan2(bend[0, 1], bend[0, 2])
    return tuple(math.degrees(j) for j in (j1, j2, j3, j4, j5, j6))
