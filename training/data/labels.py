"""Error classes and their changes under the cell's symmetries. Defined here, carried by the model card.

The simulator may not import this: a test compares its copy in simulation/closed_loop/statistics.py.
"""

import numpy as np
from numpy.typing import NDArray

from service.contract import ErrorClass

THRESHOLD_X_MM = 2.5
THRESHOLD_THETA_DEG = 5.0

CLASSES: tuple[ErrorClass, ...] = (
    ErrorClass(name="1", sign_x=-1, sign_theta=0),
    ErrorClass(name="2", sign_x=1, sign_theta=0),
    ErrorClass(name="3", sign_x=-1, sign_theta=1),
    ErrorClass(name="4", sign_x=-1, sign_theta=-1),
    ErrorClass(name="5", sign_x=1, sign_theta=1),
    ErrorClass(name="6", sign_x=1, sign_theta=-1),
    ErrorClass(name="7", sign_x=0, sign_theta=-1),
    ErrorClass(name="8", sign_x=0, sign_theta=1),
    ErrorClass(name="near", sign_x=0, sign_theta=0),
)

_INDEX = {(c.sign_x, c.sign_theta): i for i, c in enumerate(CLASSES)}
_TABLE = np.array([[_INDEX[sx, st] for st in (-1, 0, 1)] for sx in (-1, 0, 1)])
SIGNS: NDArray[np.int64] = np.array([(c.sign_x, c.sign_theta) for c in CLASSES])


def class_of(error: NDArray[np.float32]) -> NDArray[np.int64]:
    """Class index of each position error.

    ``error`` is [..., 2] in (mm, deg). A component counts once it exceeds its threshold. Raises ValueError on NaN.
    """
    if not np.isfinite(error).all():
        raise ValueError("labels contain non-finite errors; expected finite (x_mm, theta_deg)")
    threshold = np.array([THRESHOLD_X_MM, THRESHOLD_THETA_DEG], np.float32)
    signs = np.where(np.abs(error) > threshold, np.sign(error), 0).astype(np.int64)
    index: NDArray[np.int64] = _TABLE[signs[..., 0] + 1, signs[..., 1] + 1]
    return index


MIRROR_SIGNS = np.array([-1.0, -1.0], np.float32)
"""Mirroring the cell in x maps (x, theta) to (-x, -theta)."""
HALF_TURN_SIGNS = np.array([-1.0, 1.0], np.float32)
"""Turning the cell by 180 deg about z maps (x, theta) to (-x, theta) and swaps the two finger streams."""
