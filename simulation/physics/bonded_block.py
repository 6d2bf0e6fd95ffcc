"""A gel with free edges: face compliance of a bonded block by finite elements, condensed onto its face.

The block is a box on a rigid back. Its elements are linear along the pad and quadratic through the thickness; their
volumetric strain is integrated with one point in-plane and two through the thickness, so that rubber up to nu 0.4999
does not lock. Both mirror symmetries split the problem in four, and the levels of the mesh are eliminated one by one
from the back, so that one geometry takes about a second, once. Displacements are (u, v, into the pad), shear modulus 1
N/mm2.

`symbol` is the same mesh without edges, wave by wave. Its deficit against the exact kernel of an endless layer is added
to the block's compliance (`edged_layer`). Elements as large as a contact cell therefore suffice for local effects, and
a gel whose edges are far away is the endless layer.
"""

from functools import lru_cache
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from simulation.physics.elastic_layer import Grid, Kernel, bonded_layer
from simulation.scene.rubber import reach_in_thicknesses

Array = NDArray[np.float64]

LEVELS = 3  # quadratic elements through the thickness
GROWTH = 1.5  # of the elements beyond the pad


class _Line(NamedTuple):
    """Integrals of linear elements along an axis: phi phi, the same with one point, phi' phi', phi' phi."""

    mass: Array
    reduced: Array
    slope: Array
    mixed: Array


class _Depth(NamedTuple):
    """The same for one quadratic element through the thickness, [3, 3], from the back to the face."""

    mass: Array
    reduced: Array
    slope: Array
    mixed: Array


def _depth(length: float) -> _Depth:
    mass = length / 30.0 * np.array([[4.0, 2.0, -1.0], [2.0, 16.0, 2.0], [-1.0, 2.0, 4.0]])
    slope = np.array([[7.0, -8.0, 1.0], [-8.0, 16.0, -8.0], [1.0, -8.0, 7.0]]) / (3.0 * length)
    mixed = np.array([[-3.0, -4.0, 1.0], [4.0, 0.0, -4.0], [-1.0, 4.0, 3.0]]) / 6.0
    points = np.array([-1.0, 1.0]) / np.sqrt(3.0)
    at = np.stack([0.5 * points * (points - 1.0), 1.0 - points**2, 0.5 * points * (points + 1.0)])
    return _Depth(mass, 0.5 * length * at @ at.T, slope, -mixed)  # into the pad is down from the face


def _assembled(widths: Array) -> _Line:
    out = np.zeros((4, len(widths) + 1, len(widths) + 1))
    for e, width in enumerate(widths):
        at = np.s_[e : e + 2, e : e + 2]
        out[0][at] += width / 6.0 * np.array([[2.0, 1.0], [1.0, 2.0]])
        out[1][at] += width / 4.0
        out[2][at] += np.array([[1.0, -1.0], [-1.0, 1.0]]) / width
        out[3][at] += 0.5 * np.array([[-1.0, -1.0], [1.0, 1.0]])
    return _Line(*out)


def _halves(count: int) -> tuple[Array, Array]:
    """Orthonormal bases [count, m] of the even and of the odd functions under a mirror."""
    identity, turned, middle = np.eye(count), np.eye(count)[::-1], count // 2
    even = ((identity + turned) / np.sqrt(2.0))[:, : count - middle]
    if count % 2:
        even[:, -1] /= np.sqrt(2.0)
    return even, ((identity - turned) / np.sqrt(2.0))[:, :middle]


def _split(line: _Line, bases: tuple[Array, Array]) -> dict[tuple[int, int], _Line]:
    """Integrals between functions of parities (row, column)."""
    return {(p, q): _Line(*(bases[p].T @ matrix @ bases[q] for matrix in line)) for p, q in product(range(2), repeat=2)}


def _blocks(
    along: list[list[_Line]], up: list[list[_Line]], depth: _Depth, lame: float, a: int, b: int
) -> list[list[Array]]:
    """Stiffness [3][3] between levels a and b of an element, shear modulus 1; lines of component pairs [3][3]."""
    mz, rz, sz, dz = (matrix[a, b] for matrix in depth)
    zd = depth.mixed[b, a]
    out: list[list[Array]] = [[np.zeros(0)] * 3 for _ in range(3)]
    for c in range(3):
        x, y = along[c][c], up[c][c]
        two = [2.0 if c == k else 1.0 for k in range(3)]
        out[c][c] = two[0] * mz * np.kron(y.mass, x.slope) + two[1] * mz * np.kron(y.slope, x.mass)
        out[c][c] += two[2] * sz * np.kron(y.mass, x.mass)
    out[0][0] += lame * rz * np.kron(up[0][0].reduced, along[0][0].slope)
    out[1][1] += lame * rz * np.kron(up[1][1].slope, along[1][1].reduced)
    out[2][2] += lame * sz * np.kron(up[2][2].reduced, along[2][2].reduced)
    for c, d in ((0, 1), (1, 0)):  # phi_c,d phi_d,c and lame phi_c,c phi_d,d
        x, y, xt, yt = along[c][d], up[c][d], along[d][c].mixed.T, up[d][c].mixed.T
        if c == 0:
            out[c][d] = lame * rz * np.kron(yt, x.mixed) + mz * np.kron(y.mixed, xt)
        else:
            out[c][d] = lame * rz * np.kron(y.mixed, xt) + mz * np.kron(yt, x.mixed)
    x, y = along[0][2], up[0][2]
    out[0][2] = lame * zd * np.kron(y.reduced, x.mixed) + dz * np.kron(y.mass, along[2][0].mixed.T)
    x, y = along[1][2], up[1][2]
    out[1][2] = lame * zd * np.kron(y.mixed, x.reduced) + dz * np.kron(up[2][1].mixed.T, x.mass)
    x, y = along[2][0], up[2][0]
    out[2][0] = lame * dz * np.kron(y.reduced, along[0][2].mixed.T) + zd * np.kron(y.mass, x.mixed)
    x, y = along[2][1], up[2][1]
    out[2][1] = lame * dz * np.kron(up[1][2].mixed.T, x.reduced) + zd * np.kron(y.mixed, x.mass)
    return out


def _element(along: list[list[_Line]], up: list[list[_Line]], depth: _Depth, lame: float) -> list[list[Array]]:
    """Stiffness [3][3] between the levels of one element: back, middle, face."""
    return [[np.block(_blocks(along, up, depth, lame, a, b)) for b in range(3)] for a in range(3)]


def _condensed(element: list[list[Array]]) -> Array:
    """Stiffness of the face of LEVELS equal elements on a rigid back."""
    (bb, bm, bt), (mb, mm, mt), (_, _, tt) = element[0], element[1], element[2]
    face = tt - mt.T @ cho_solve(cho_factor(mm), mt)
    for _ in range(LEVELS - 1):
        inner, upper = np.block([[face + bb, bm], [mb, mm]]), np.vstack([bt, mt])
        face = tt - upper.T @ cho_solve(cho_factor(inner), upper)
        face = 0.5 * (face + face.T)
    return np.asarray(face)


def _widths(cells: int, pitch: float, beyond: float) -> Array:
    """Elements along an axis: one per cell on the pad, growing ones beyond it on either side."""
    if beyond <= 1e-9:
        return np.full(cells, pitch)
    count = 1
    while pitch * (GROWTH**count - 1.0) / (GROWTH - 1.0) < beyond:
        count += 1
    outer = GROWTH ** np.arange(count)
    outer *= beyond / outer.sum()
    return np.concatenate([outer[::-1], np.full(cells, pitch), outer])


def _mean_on_cells(widths: Array, cells: int) -> Array:
    """Cells [cells, nodes] of the pad as the mean of the nodes at their ends."""
    out = np.zeros((cells, len(widths) + 1))
    first = (len(widths) - cells) // 2
    for k in range(cells):
        out[k, first + k : first + k + 2] = 0.5
    return out


PARITIES = ((0, 0), (0, 1), (1, 0), (1, 1))
"""Parities (along u, along v) of the normal displacement; the displacement along an axis has the other parity there."""


def _of_component(c: int, parity: tuple[int, int]) -> tuple[int, int]:
    return (1 - parity[0] if c == 0 else parity[0]), (1 - parity[1] if c == 1 else parity[1])


@lru_cache(maxsize=8)
def face_compliance(
    grid: Grid, thickness_mm: float, poisson: float, beyond_mm: tuple[float, float]
) -> tuple[Array, ...]:
    """Compliance [m, m] in mm3/N for 1 N/mm2 of shear modulus, for each of PARITIES, on even or odd parts of the cells.

    beyond_mm (u, v): extent of the block beyond the grid on either side. Components (u, v, into the pad) follow one
    another, each with its rows of v outside and columns of u inside.
    """
    widths_u, widths_v = (
        _widths(grid.columns, grid.pitch_u_mm, beyond_mm[0]),
        _widths(grid.rows, grid.pitch_v_mm, beyond_mm[1]),
    )
    nodes = _halves(len(widths_u) + 1), _halves(len(widths_v) + 1)
    lines = _split(_assembled(widths_u), nodes[0]), _split(_assembled(widths_v), nodes[1])
    cells = _halves(grid.columns), _halves(grid.rows)
    means = _mean_on_cells(widths_u, grid.columns), _mean_on_cells(widths_v, grid.rows)
    depth, lame = _depth(thickness_mm / LEVELS), 2.0 * poisson / (1.0 - 2.0 * poisson)
    out = []
    for parity in PARITIES:
        kinds = [_of_component(c, parity) for c in range(3)]
        along = [[lines[0][one[0], other[0]] for other in kinds] for one in kinds]
        up = [[lines[1][one[1], other[1]] for other in kinds] for one in kinds]
        parts = [np.kron(*(cells[k][kind[k]].T @ means[k] @ nodes[k][kind[k]] for k in (1, 0))) for kind in kinds]
        mean = np.zeros((sum(len(part) for part in parts), sum(part.shape[1] for part in parts)))
        row = column = 0
        for part in parts:
            mean[row : row + part.shape[0], column : column + part.shape[1]] = part
            row, column = row + part.shape[0], column + part.shape[1]
        face = _condensed(_element(along, up, depth, lame))
        compliance = grid.pitch_u_mm * grid.pitch_v_mm * mean @ cho_solve(cho_factor(face), mean.T)
        out.append(0.5 * (compliance + compliance.T))
    return tuple(out)


def symbol(ku: Array, kv: Array, grid: Grid, thickness_mm: float, poisson: float) -> NDArray[np.complex128]:
    """The mesh's compliance of an endless layer, [3, 3, ...] in mm3/N for 1 N/mm2; waves ku, kv in rad/mm."""
    depth, lame = _depth(thickness_mm / LEVELS), 2.0 * poisson / (1.0 - 2.0 * poisson)

    def line(k: Array, pitch: float) -> tuple[Array, Array, Array, NDArray[np.complex128]]:
        cos = np.cos(k * pitch)
        return pitch * (2.0 + cos) / 3.0, pitch * (1.0 + cos) / 2.0, 2.0 * (1.0 - cos) / pitch, -1j * np.sin(k * pitch)

    (mx, rx, sx, dx), (my, ry, sy, dy) = line(ku, grid.pitch_u_mm), line(kv, grid.pitch_v_mm)
    blocks = np.zeros((3, 3, *ku.shape, 3, 3), np.complex128)
    for a, b in product(range(3), repeat=2):
        mz, rz, sz, dz = (matrix[a, b] for matrix in depth)
        zd, into = depth.mixed[b, a], blocks[a, b]
        shear = (sx * my + mx * sy) * mz + mx * my * sz
        into[..., 0, 0] = shear + sx * my * mz + lame * rz * sx * ry
        into[..., 1, 1] = shear + mx * sy * mz + lame * rz * rx * sy
        into[..., 2, 2] = shear + mx * my * sz + lame * sz * rx * ry
        into[..., 0, 1] = lame * rz * dx * dy.conj() + mz * dx.conj() * dy
        into[..., 1, 0] = lame * rz * dx.conj() * dy + mz * dx * dy.conj()
        into[..., 0, 2] = lame * zd * dx * ry + dz * dx.conj() * my
        into[..., 1, 2] = lame * zd * dy * rx + dz * dy.conj() * mx
        into[..., 2, 0] = lame * dz * dx.conj() * ry + zd * dx * my
        into[..., 2, 1] = lame * dz * dy.conj() * rx + zd * dy * mx
    face = blocks[2, 2] - blocks[2, 1] @ np.linalg.solve(blocks[1, 1], blocks[1, 2])
    for _ in range(LEVELS - 1):
        inner = np.concatenate(
            [
                np.concatenate([face + blocks[0, 0], blocks[0, 1]], -1),
                np.concatenate([blocks[1, 0], blocks[1, 1]], -1),
            ],
            -2,
        )
        upper, lower = (
            np.concatenate([blocks[0, 2], blocks[1, 2]], -2),
            np.concatenate([blocks[2, 0], blocks[2, 1]], -1),
        )
        face = blocks[2, 2] - lower @ np.linalg.solve(inner, upper)
    mean = (np.cos(0.5 * ku * grid.pitch_u_mm) * np.cos(0.5 * kv * grid.pitch_v_mm)) ** 2
    answer = grid.pitch_u_mm * grid.pitch_v_mm * mean[..., None, None] * np.linalg.inv(face)
    return np.asarray(np.moveaxis(answer, (-2, -1), (0, 1)), np.complex128)


class EdgedLayer(Kernel):
    """Compliance of a bonded layer with free edges, beyond_mm (u, v) beyond the grid on either side."""

    def __init__(
        self,
        grid: Grid,
        thickness_mm: float,
        shear_modulus_n_per_mm2: float,
        poisson: float,
        beyond_mm: tuple[float, float],
    ) -> None:
        """Raises ValueError as `bonded_layer` does."""
        endless = bonded_layer(grid, thickness_mm, shear_modulus_n_per_mm2, poisson)
        reach_mm = reach_in_thicknesses(poisson) * thickness_mm
        ends = (min(max(beyond_mm[0], 0.0), reach_mm), min(max(beyond_mm[1], 0.0), reach_mm))
        shape = endless.shape
        kv = 2.0 * np.pi * np.fft.fftfreq(shape[0], grid.pitch_v_mm)[:, None] + np.zeros((1, shape[1] // 2 + 1))
        ku = 2.0 * np.pi * np.fft.rfftfreq(shape[1], grid.pitch_u_mm)[None, :] + np.zeros((shape[0], 1))
        mesh = symbol(ku, kv, grid, thickness_mm, poisson) / shear_modulus_n_per_mm2
        super().__init__(grid, endless.spectrum - mesh, shape)
        self._softness = 1.0 / shear_modulus_n_per_mm2
        self._faces = face_compliance(grid, thickness_mm, poisson, ends)
        self._bases = [np.concatenate(_halves(count), axis=1) for count in (grid.rows, grid.columns)]
        rows, columns = (((count + 1) // 2, count) for count in (grid.rows, grid.columns))
        halves = [[slice(0, ends[0]), slice(*ends)] for ends in (rows, columns)]
        self._places = [
            [(halves[0][kind[1]], halves[1][kind[0]]) for kind in (_of_component(c, parity) for c in range(3))]
            for parity in PARITIES
        ]

    def __call__(self, traction: Array) -> Array:
        """Displacements [2, rows, columns, 3] in mm of tractions of that shape in N/mm2."""
        by_v, by_u = self._bases
        parts = np.einsum("rp,frcx,cq->xfpq", by_v, traction, by_u, optimize=True)
        answer = np.empty_like(parts)
        for face, places in zip(self._faces, self._places, strict=True):
            pieces = [parts[c][:, rows, columns] for c, (rows, columns) in enumerate(places)]
            moved = np.concatenate([piece.reshape(2, -1) for piece in pieces], axis=1) @ face
            start = 0
            for c, (piece, (rows, columns)) in enumerate(zip(pieces, places, strict=True)):
                size = piece[0].size
                answer[c][:, rows, columns] = moved[:, start : start + size].reshape(piece.shape)
                start += size
        block = np.einsum("rp,xfpq,cq->frcx", by_v, answer, by_u, optimize=True)
        return np.asarray(super().__call__(traction) + self._softness * block)

    @property
    def largest_mm3_per_n(self) -> tuple[float, float]:
        """Bounds of the largest eigenvalues of the tangential and of the normal compliance, mm3/N."""
        tangential, normal = super().largest_mm3_per_n
        sizes = [[(r.stop - r.start) * (c.stop - c.start) for r, c in places] for places in self._places]
        shear = max(
            np.linalg.norm(face[: -size[2], : -size[2]], 2) for face, size in zip(self._faces, sizes, strict=True)
        )
        press = max(
            np.linalg.norm(face[-size[2] :, -size[2] :], 2) for face, size in zip(self._faces, sizes, strict=True)
        )
        return tangential + self._softness * float(shear), normal + self._softness * float(press)
