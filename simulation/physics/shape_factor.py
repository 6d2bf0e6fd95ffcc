"""Local stiffness of a bonded pad against compression: closed forms of shape factor and edge distance.

Gent and Lindley (1959), Gent and Meinecke (1970): a bonded block of incompressible rubber resists by its Young's
modulus E and by the pressure that drives rubber to its free sides; Lindley (1979) adds compressibility. In one
equation, exact for a thin wide pad (oedometric modulus M) and for a slender block (E): the stress under a compression e
is (E + (M - E) s) e, where lambda^2 lap(s) = s - 1, lambda^2 = t^2 (M - E) / (12 G), s = 0 at the sides.
"""

import math

import numpy as np
from numpy.typing import NDArray

from simulation.scene.rubber import flow_length, normal_ratio

Array = NDArray[np.float64]

TERMS = 60  # odd sines along each axis
FREE_FACE, FACE_WITHIN = 0.35, 0.8
"""In a gel that goes on beyond the contact, pressure is borne at most FREE_FACE thicknesses further, approached
exponentially over FACE_WITHIN thicknesses of margin. Least squares on the layer tier's stiffness over thickness 1.5 to
4 mm and nu 0.4 to 0.495, 5 % at worst.
"""


def modulus_profile(u: Array, v: Array, half_mm: tuple[float, float], thickness_mm: float, poisson: float) -> Array:
    """Apparent modulus over shear modulus [v, u] at places (mm from the middle) of a block with half sizes (u, v)."""
    young = 2.0 * (1.0 + poisson)
    length_mm = flow_length(poisson) * thickness_mm
    wave = np.pi * (np.arange(TERMS) + 0.5)
    weights = 2.0 * (-1.0) ** np.arange(TERMS) / wave  # coefficients of 1 as a sum of cosines that vanish at the sides
    along, up = (np.cos(np.outer(at, wave / half)) * weights for at, half in zip((u, v), half_mm, strict=True))
    square = (wave / half_mm[0])[None, :] ** 2 + (wave / half_mm[1])[:, None] ** 2
    share = up @ (1.0 / (1.0 + length_mm**2 * square)) @ along.T
    return np.asarray(young + (normal_ratio(poisson) - young) * share)


def borne_beyond_mm(beyond_mm: float, thickness_mm: float) -> float:
    """Distance beyond a contact over which pressure is borne, in a gel that ends beyond_mm beyond it."""
    return FREE_FACE * thickness_mm * (1.0 - math.exp(-max(beyond_mm, 0.0) / (FACE_WITHIN * thickness_mm)))
