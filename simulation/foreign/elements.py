"""A gel pad of finite elements, condensed onto the touchable nodes of its face.

The pad is a block of quadratic hexahedra (27 nodes), bonded to the finger at its back. Pad frame: x along the pad, y
out of the gel towards the object, z up the pad; the face at rest lies at y = 0. Volume changes use pressures that are
linear within each element and eliminated there (Q2/P1 discontinuous: inf-sup stable, so that a Poisson's ratio near 0.5
does not lock; Bathe, Finite Element Procedures, 1996, 4.5). Strains are small. All other nodes are eliminated once
(Schur's complement), which is exact.
"""

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix, diags
from scipy.sparse.linalg import splu
from skfem import Basis, BilinearForm, ElementHex0, ElementHex2, ElementVector, FacetBasis, LinearForm, MeshHex
from skfem.helpers import ddot, div, sym_grad

Array = NDArray[np.float64]

ENDLESS_THICKNESSES = 3.0  # a load's trace falls by exp(-pi / 2) per thickness: more gel changes nothing


class Pad(NamedTuple):
    """A pad: its touchable face of width (x) times height (z), and its division into elements.

    margin (x, z): extent of the gel beyond that face on either side. columns, rows, layers: elements.
    """

    width_mm: float
    height_mm: float
    thickness_mm: float
    poisson_ratio: float
    margin_mm: tuple[float, float] = (0.0, 0.0)
    columns: int = 6
    rows: int = 6
    layers: int = 2


class Face(NamedTuple):
    """A pad as its contacts see it. Its n nodes are a grid [2 rows + 1, 2 columns + 1], z then x.

    x, z [columns], [rows]: places of the grid's lines, mm. area [n]: mm2 of the face that a node represents. stiffness
    [3 n, 3 n]: nodal forces (x, y, z of each node, N) over displacements (mm), for a shear modulus of 1 N/mm2.
    """

    x: Array
    z: Array
    area: Array
    stiffness: Array

    @property
    def rest(self) -> Array:
        """Rest positions of the nodes, [n, 3], mm."""
        z, x = np.meshgrid(self.z, self.x, indexing="ij")
        return np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=1)


def _lines(half_mm: float, margin_mm: float, count: int, thickness_mm: float) -> Array:
    """Element borders across a pad; in the margin elements grow outwards."""
    inner: Array = np.linspace(-half_mm, half_mm, count + 1)
    margin_mm = min(margin_mm, ENDLESS_THICKNESSES * thickness_mm)
    if margin_mm < 1e-6:
        return inner
    steps = np.cumsum(1.6 ** np.arange(max(1, math.ceil(margin_mm / thickness_mm))))
    outer = half_mm + margin_mm * steps / steps[-1]
    return np.concatenate([-outer[::-1], inner, outer])


def stiffness_matrix(basis: Basis, poisson_ratio: float) -> csc_matrix:
    """Stiffness of all displacements of a mesh of bricks, for a shear modulus of 1."""

    @BilinearForm
    def shear(u: Any, v: Any, _w: Any) -> Any:
        return 2.0 * ddot(sym_grad(u), sym_grad(v))

    @BilinearForm
    def volume(u: Any, q: Any, w: Any) -> Any:
        return div(u) * q * w.mode

    total = shear.assemble(basis)
    elements = basis.with_element(ElementHex0())
    size_mm3 = basis.dx.sum(axis=1)
    bulk = 2.0 * poisson_ratio / (1.0 - 2.0 * poisson_ratio)
    modes = [np.ones_like(basis.X[0]), *(axis - 0.5 for axis in basis.X)]
    for mode, mean_square in zip(modes, (1.0, 1.0 / 12.0, 1.0 / 12.0, 1.0 / 12.0), strict=True):
        change = volume.assemble(basis, elements, mode=np.broadcast_to(mode, basis.dx.shape))
        total = total + change.T @ diags(bulk / (mean_square * size_mm3)) @ change
    return csc_matrix(total)


@lru_cache(maxsize=8)
def face_of(pad: Pad) -> Face:
    """The condensed face of a pad; computed once per geometry. Raises ValueError for an impossible pad."""
    if not (min(pad.width_mm, pad.height_mm, pad.thickness_mm) > 0.0 and 0.0 <= pad.poisson_ratio < 0.5):
        raise ValueError(f"gel: expected sizes > 0 mm and 0 <= Poisson's ratio < 0.5, got {pad}")
    x = _lines(0.5 * pad.width_mm, pad.margin_mm[0], pad.columns, pad.thickness_mm)
    z = _lines(0.5 * pad.height_mm, pad.margin_mm[1], pad.rows, pad.thickness_mm)
    mesh = MeshHex.init_tensor(x, np.linspace(-pad.thickness_mm, 0.0, pad.layers + 1), z)
    basis = Basis(mesh, ElementVector(ElementHex2()), intorder=4)
    dofs = np.concatenate([basis.nodal_dofs, basis.edge_dofs, basis.facet_dofs, basis.interior_dofs], axis=1)
    place = basis.doflocs[:, dofs[0]]
    half = np.array([0.5 * pad.width_mm, 0.5 * pad.height_mm])[:, None] + 1e-9
    touched = np.flatnonzero((place[1] > -1e-9) & (np.abs(place[[0, 2]]) < half).all(axis=0))
    touched = touched[np.lexsort(np.round(place[[0, 2]][:, touched], 6))]
    face, held = dofs[:, touched].T.ravel(), dofs[:, place[1] < 1e-9 - pad.thickness_mm].ravel()
    grid = np.round(place[:, touched], 9).reshape(3, 2 * pad.rows + 1, 2 * pad.columns + 1)
    matrix = _condensed(stiffness_matrix(basis, pad.poisson_ratio), face, held)
    return Face(grid[0, 0], grid[2, :, 0], _areas(mesh, half[:, 0], dofs[1, touched]), matrix)


def _condensed(matrix: csc_matrix, face: NDArray[np.intp], held: NDArray[np.intp]) -> Array:
    inside = np.setdiff1d(np.arange(matrix.shape[0]), np.concatenate([face, held]))
    coupling = matrix[np.ix_(inside, face)].toarray()
    factor = splu(csc_matrix(matrix[np.ix_(inside, inside)]), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0)
    answer = factor.solve(coupling)
    out = matrix[np.ix_(face, face)].toarray() - coupling.T @ answer
    return np.asarray(0.5 * (out + out.T))


def _areas(mesh: MeshHex, half_mm: Array, dofs: NDArray[np.intp]) -> Array:
    """The area of each node of the face, mm2: a uniform pressure's nodal forces."""
    facets = mesh.facets_satisfying(
        lambda x: np.isclose(x[1], 0.0) & (np.abs(x[0]) < half_mm[0]) & (np.abs(x[2]) < half_mm[1])
    )
    pressed = FacetBasis(mesh, ElementVector(ElementHex2()), facets=facets, intorder=4)
    return np.asarray(LinearForm(lambda v, _w: v[1]).assemble(pressed)[dofs])
