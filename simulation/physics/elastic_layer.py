"""Displacement of a gel's surface under tractions: influence kernels of an elastic layer, by FFT.

A pad's fields are [2, rows, columns, 3] in finger frame: along u, along v, into the pad (pressure positive). A kernel
maps tractions (N/mm2, constant on each cell) to displacements (mm) at the cells' centres. The layer is bonded to a
rigid back; its compliance follows wave by wave from Navier's equations. The tests check the terms in `bonded_layer`
against their matrix exponential, and the solver against Hertz and Mindlin on a half-space.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from simulation.scene.rubber import reach_in_thicknesses

Array = NDArray[np.float64]

ALIASES = 4  # aliased waves of a cell's constant traction, on each side; they fall with the cube of their number


@dataclass(frozen=True, slots=True)
class Grid:
    """A pad's cells: rows along v, columns along u, and their sizes in mm."""

    rows: int
    columns: int
    pitch_v_mm: float
    pitch_u_mm: float


class Kernel:
    """A translation-invariant compliance on a grid: call with tractions [2, rows, columns, 3], get displacements."""

    def __init__(self, grid: Grid, spectrum: NDArray[np.complex128], shape: tuple[int, int]) -> None:
        self.grid, self.shape = grid, shape
        self.spectrum = spectrum  # [3, 3, shape[0], shape[1] // 2 + 1]

    def __call__(self, traction: Array) -> Array:
        waves = np.fft.rfft2(traction, s=self.shape, axes=(1, 2))
        answer = np.einsum("abvu,fvub->fvua", self.spectrum, waves)
        whole = np.fft.irfft2(answer, s=self.shape, axes=(1, 2))
        return np.ascontiguousarray(whole[:, : self.grid.rows, : self.grid.columns])

    @property
    def largest_mm3_per_n(self) -> tuple[float, float]:
        """Largest eigenvalue of the tangential and of the normal compliance over all waves, mm3/N."""
        tangential = np.moveaxis(self.spectrum[:2, :2], (0, 1), (-2, -1))
        return float(np.linalg.norm(tangential, 2, axis=(-2, -1)).max()), float(np.abs(self.spectrum[2, 2]).max())


def layer_compliance(
    ku: Array, kv: Array, thickness_mm: float, shear_modulus_n_per_mm2: float, poisson: float
) -> NDArray[np.complex128]:
    """Compliance [3, 3, ...] in mm3/N of a bonded layer for tractions that vary as exp(i (ku u + kv v)), rad/mm."""
    still = (ku == 0.0) & (kv == 0.0)
    k = np.where(still, 1e-6, np.hypot(ku, kv))
    q, kappa = k * thickness_mm, 3.0 - 4.0 * poisson
    # all terms of the textbook form are divided by cosh(2q)'s growth, exp(2q) / 2, so that no wave overflows
    decay = np.exp(-2.0 * q)
    sinh, cosh, one = 1.0 - decay * decay, 1.0 + decay * decay, 2.0 * decay
    common = kappa * cosh + one * (2.0 * q * q + 5.0 - 12.0 * poisson + 8.0 * poisson**2)
    scale = 1.0 / (shear_modulus_n_per_mm2 * k)
    along = scale * (1.0 - poisson) * (kappa * sinh + 2.0 * q * one) / common
    normal = scale * (1.0 - poisson) * (kappa * sinh - 2.0 * q * one) / common
    across = scale * np.tanh(q)
    coupling = -1j * scale * (one * q * q - 0.5 * (1.0 - 2.0 * poisson) * kappa * (cosh - one)) / common
    return _turned(np.where(still, 1.0, ku / k), kv / k, along, across, normal, coupling)


def _turned(
    cu: Array, cv: Array, along: Array, across: Array, normal: Array, coupling: NDArray[np.complexfloating]
) -> NDArray[np.complex128]:
    """Compliance in (u, v, normal) from that along a wave of direction (cu, cv), across it and into the pad."""
    out = np.empty((3, 3, *along.shape), dtype=np.complex128)
    out[0, 0], out[1, 1] = cu * cu * along + cv * cv * across, cv * cv * along + cu * cu * across
    out[0, 1] = out[1, 0] = cu * cv * (along - across)
    out[0, 2], out[1, 2] = cu * coupling, cv * coupling
    out[2, 0], out[2, 1] = -out[0, 2], -out[1, 2]
    out[2, 2] = normal
    return out


def bonded_layer(grid: Grid, thickness_mm: float, shear_modulus_n_per_mm2: float, poisson: float) -> Kernel:
    """Kernel of a layer bonded to a rigid back, with all edges far enough away not to matter.

    Raises:
        ValueError: a Poisson's ratio outside -1..0.5, or a thickness or modulus that is not positive.
    """
    _must_be_material(shear_modulus_n_per_mm2, poisson)
    if not thickness_mm > 0.0:
        raise ValueError(f"layer: expected a thickness > 0 mm, got {thickness_mm}")
    reach = reach_in_thicknesses(poisson) * thickness_mm
    shape = (
        _even(grid.rows + max(grid.rows // 2, math.ceil(reach / grid.pitch_v_mm))),
        _even(grid.columns + max(grid.columns // 2, math.ceil(reach / grid.pitch_u_mm))),
    )
    kv = 2.0 * np.pi * np.fft.fftfreq(shape[0], grid.pitch_v_mm)[:, None]
    ku = 2.0 * np.pi * np.fft.rfftfreq(shape[1], grid.pitch_u_mm)[None, :]
    total = np.zeros((3, 3, shape[0], shape[1] // 2 + 1), dtype=np.complex128)
    for i in range(-ALIASES, ALIASES + 1):
        for j in range(-ALIASES, ALIASES + 1):
            wave_v = kv + 2.0 * np.pi * i / grid.pitch_v_mm + 0.0 * ku
            wave_u = ku + 2.0 * np.pi * j / grid.pitch_u_mm + 0.0 * kv
            cell = np.sinc(wave_v * grid.pitch_v_mm / (2.0 * np.pi)) * np.sinc(wave_u * grid.pitch_u_mm / (2.0 * np.pi))
            total += cell * layer_compliance(wave_u, wave_v, thickness_mm, shear_modulus_n_per_mm2, poisson)
    odd_v, odd_u = shape[0] // 2, shape[1] // 2  # the odd part of a wave number vanishes at its end
    for a, b in ((1, 2), (2, 1), (0, 1), (1, 0)):
        total[a, b, odd_v] = 0.0
    for a, b in ((0, 2), (2, 0), (0, 1), (1, 0)):
        total[a, b, :, odd_u] = 0.0
    return Kernel(grid, total, shape)


def _must_be_material(shear_modulus_n_per_mm2: float, poisson: float) -> None:
    if not (shear_modulus_n_per_mm2 > 0.0 and -1.0 < poisson <= 0.5):
        raise ValueError(
            f"gel: expected a shear modulus > 0 and -1 < Poisson's ratio <= 0.5, got {shear_modulus_n_per_mm2}, "
            f"{poisson}"
        )


def _even(count: int) -> int:
    return count + count % 2
