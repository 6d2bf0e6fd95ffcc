"""The influence kernel of an elastic half-space, on which theory knows the answer: Hertz, Cattaneo and Mindlin.

It integrates Boussinesq's and Cerruti's solutions over a cell (Love 1929; Johnson, Contact Mechanics, 1985, ch. 3).
"""

import numpy as np
from numpy.typing import NDArray

from simulation.physics.elastic_layer import Grid, Kernel

Array = NDArray[np.float64]


def half_space(grid: Grid, shear_modulus_n_per_mm2: float, poisson: float) -> Kernel:
    """Kernel of an elastic half-space, exact for tractions that are constant on each cell."""
    rows, columns = 2 * grid.rows, 2 * grid.columns
    # offsets 0, 1, .. n - 1, then -n .. -1: the circular convolution of doubled size is the plain one on the pad
    v = np.fft.fftfreq(rows, 1.0 / rows)[:, None] * grid.pitch_v_mm + np.zeros((1, columns))
    u = np.fft.fftfreq(columns, 1.0 / columns)[None, :] * grid.pitch_u_mm + np.zeros((rows, 1))
    inverse, uu, vv, uv, pull_u, pull_v = _cell_integrals(u, v, grid)
    scale = 1.0 / (2.0 * np.pi * shear_modulus_n_per_mm2)
    lean = 0.5 * (1.0 - 2.0 * poisson)
    out = np.empty((3, 3, rows, columns))
    out[0, 0], out[1, 1] = (1.0 - poisson) * inverse + poisson * uu, (1.0 - poisson) * inverse + poisson * vv
    out[0, 1] = out[1, 0] = poisson * uv
    out[0, 2], out[1, 2] = -lean * pull_u, -lean * pull_v
    out[2, 0], out[2, 1] = lean * pull_u, lean * pull_v
    out[2, 2] = (1.0 - poisson) * inverse
    return Kernel(grid, np.fft.rfft2(scale * out), (rows, columns))


def _cell_integrals(u: Array, v: Array, grid: Grid) -> tuple[Array, ...]:
    """Integrals over a cell, seen from (u, v) away: 1/r, u^2/r^3, v^2/r^3, u v/r^3, u/r^2, v/r^2."""
    sums = np.zeros((6, *u.shape))
    for su in (-0.5, 0.5):
        for sv in (-0.5, 0.5):
            a, b = u + su * grid.pitch_u_mm, v + sv * grid.pitch_v_mm
            r = np.hypot(a, b)
            x, y = b * np.log(a + r), a * np.log(b + r)
            parts = (x + y, x, y, -r, b * np.log(r) + a * np.arctan(b / a), a * np.log(r) + b * np.arctan(a / b))
            sums += np.sign(su * sv) * np.stack(parts)
    return tuple(sums)
