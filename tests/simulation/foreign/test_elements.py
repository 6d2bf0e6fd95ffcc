"""The finite-element pad beside closed forms."""

import numpy as np
import pytest
from skfem import Basis, ElementHex2, ElementVector, MeshHex

from simulation.foreign.elements import Pad, face_of, stiffness_matrix

WIDE, HIGH, THICK = 22.05, 21.0, 2.5


def pushed(face, axis):
    """Force over displacement of the whole face along one axis, N/mm per N/mm2."""
    motion = np.zeros((len(face.area), 3))
    motion[:, axis] = 1.0
    return float(motion.ravel() @ face.stiffness @ motion.ravel())


@pytest.mark.parametrize("poisson", [0.3, 0.48, 0.499])
def test_patch_of_uneven_bricks_keeps_any_uniform_strain(poisson):
    mesh = MeshHex.init_tensor(np.array([0.0, 1.0, 2.5]), np.array([0.0, 0.7, 1.0]), np.array([0.0, 0.4, 2.0]))
    basis = Basis(mesh, ElementVector(ElementHex2()), intorder=4)
    dofs = np.concatenate([basis.nodal_dofs, basis.edge_dofs, basis.facet_dofs, basis.interior_dofs], axis=1)
    strain = np.array([[1.0, 0.3, -0.2], [0.3, -0.4, 0.5], [-0.2, 0.5, -0.6 + 0.1 * poisson]])
    place, motion = basis.doflocs[:, dofs[0]], np.zeros(basis.N)
    motion[dofs] = strain @ place
    force = (stiffness_matrix(basis, poisson) @ motion)[dofs]
    inside = (np.abs(place - [[1.25], [0.5], [1.0]]) < [[1.25 - 1e-9], [0.5 - 1e-9], [1.0 - 1e-9]]).all(axis=0)
    assert inside.sum() == 27
    assert np.abs(force[:, inside]).max() < 1e-8 * np.abs(force).max()
    stress = 2.0 * strain + 2.0 * poisson / (1.0 - 2.0 * poisson) * np.trace(strain) * np.eye(3)
    right = place[0] > 2.5 - 1e-9
    assert force[:, right].sum(axis=1) == pytest.approx(2.0 * stress[:, 0], abs=1e-7 * np.abs(stress).max())


def test_a_wide_thin_pad_shears_by_force_over_g_and_presses_by_the_oedometric_modulus():
    face = face_of(Pad(60.0, 60.0, 1.0, 0.3, columns=4, rows=4, layers=1))
    assert pushed(face, 0) == pytest.approx(3600.0, rel=0.02)
    assert pushed(face, 1) == pytest.approx(3600.0 * 2.0 * 0.7 / 0.4, rel=0.03)


def test_a_bonded_block_presses_as_gent_and_lindley_say():
    """E (1 + 2 S^2) for a nearly incompressible bonded block of shape factor S, to a twentieth."""
    face = face_of(Pad(WIDE, HIGH, THICK, 0.499))
    shape = WIDE * HIGH / (2.0 * THICK * (WIDE + HIGH))
    assert pushed(face, 1) == pytest.approx(3.0 * (1.0 + 2.0 * shape**2) * WIDE * HIGH / THICK, rel=0.05)


@pytest.mark.parametrize("poisson", [*(pytest.param(ratio, marks=pytest.mark.slow) for ratio in (0.45, 0.49)), 0.495])
def test_no_poisson_ratio_locks(poisson):
    """Half as many elements press as stiffly, to 3 %: one that locks is stiffer several times over."""
    coarse = pushed(face_of(Pad(WIDE, HIGH, THICK, poisson, columns=3, rows=3)), 1)
    fine = pushed(face_of(Pad(WIDE, HIGH, THICK, poisson)), 1)
    assert coarse == pytest.approx(fine, rel=0.03)


@pytest.mark.slow
def test_more_gel_around_the_contact_makes_it_stiffer_until_it_is_endless():
    stiffness = [pushed(face_of(Pad(WIDE, HIGH, THICK, 0.48, (m, m), 3, 3, 1)), 0) for m in (0.0, 2.0, 7.5, 80.0)]
    assert stiffness[0] < stiffness[1] < stiffness[2]
    assert stiffness[2] == pytest.approx(stiffness[3], rel=1e-9)
    assert stiffness[0] < WIDE * HIGH / THICK < stiffness[3]


def test_the_face_is_symmetric_positive_and_weighs_its_area():
    face = face_of(Pad(WIDE, HIGH, THICK, 0.48))
    assert face.area.sum() == pytest.approx(WIDE * HIGH)
    assert np.linalg.eigvalsh(face.stiffness).min() > 0.0
    assert len(face.area) == 13 * 13


def test_a_pad_that_cannot_be_is_refused():
    with pytest.raises(ValueError, match="Poisson"):
        face_of(Pad(WIDE, HIGH, THICK, 0.5))
