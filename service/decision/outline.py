"""Errors at which an object enters the gap, for each of its possible outlines: its shape is not known.

An object enters where its outline, yawed by the error, is no wider than the gap: |x| + growth(yaw) <= clearance. A
rectangle grows by half its length times the sine of the yaw, that is by 0.9 mm per degree at 100 mm of length; a round
or hexagonal outline hardly grows, and a polygon lies between. The length along the gap is the held width, which the
gripper reports.
"""

import math

import numpy as np

from service.decision.evidence import Floats

# Shares of a rectangle's growth: round or hexagonal, polygon, rectangle (medians of drawn objects).
YAW_SHARES = (0.0, 0.3, 1.0)
SOFT_MM = 0.35  # blur of the clearance by the belief's cells and the creep in the hand
WRAPS_AT = 28.0  # softness lengths beyond the clearance: a chance of exp(-28), below 1e-12


class Outlines:
    """Chances to enter, for every outline on a grid of errors: ``cells`` [n], evenly spaced, are both axes, mm and deg.

    ``tolerance``: the clearance in mm, and the yaw in deg at which a rectangle of usual length uses up all of it.
    ``length_mm``: the object's length along the gap, None if the gripper does not report it.
    """

    def __init__(self, cells: Floats, tolerance: tuple[float, float], length_mm: float | None) -> None:
        self._clearance_mm = tolerance[0]
        self._half_length_mm = 0.5 * length_mm if length_mm else tolerance[0] / math.sin(math.radians(tolerance[1]))
        count, step = len(cells), float(cells[1] - cells[0])
        # No outline enters from far off in x, but a round one enters from any yaw: the yaw axis is twice as long.
        reach = math.ceil((tolerance[0] + WRAPS_AT * SOFT_MM) / step)
        self._count, self._size = count, (60 * math.ceil((count + reach) / 60), 60 * math.ceil(count / 30))
        away = [np.asarray(step * np.fft.ifftshift(np.arange(n) - n // 2), np.float64) for n in self._size]
        self._kernels = np.fft.rfft2(self.chances(*away))

    def chances(self, x_mm: Floats, theta_deg: Floats) -> Floats:
        """[outlines, n, m]: chance of each outline to enter at errors x [n] and yaw [m]."""
        whole_mm = self._half_length_mm * np.abs(np.sin(np.radians(theta_deg)))
        left_mm = self._clearance_mm - np.abs(x_mm)[:, None] - np.multiply.outer(YAW_SHARES, whole_mm)[:, None, :]
        return np.asarray(0.5 * (1.0 + np.tanh(0.5 * left_mm / SOFT_MM)), np.float64)

    def hits(self, probability: Floats) -> Floats:
        """[n, n]: chance to enter when aimed at each cell, from a probability [outlines, n, n] of errors."""
        spectrum = np.fft.rfft2(probability, self._size)
        whole = np.fft.irfft2((spectrum * self._kernels).sum(0), self._size)
        return np.asarray(np.maximum(whole[: self._count, : self._count], 0.0), np.float64)
