"""The slip rule of the paper's group in 2019, the baseline of the report."""

import numpy as np

from service.perception.markers.field import MarkerField


def rule_2019(field: MarkerField, reference: MarkerField) -> bool:
    """Dong et al. 2019: slip if more than 7 markers deviate by more than 0.30 pitch from the rigid prediction.

    The prediction is one least-squares rigid motion of all valid markers.
    """
    may = (field.valid & reference.valid).reshape(-1)
    x = (reference.rest_px + reference.displacement_px).reshape(-1, 2)[may].astype(np.float64)
    y = (field.rest_px + field.displacement_px).reshape(-1, 2)[may].astype(np.float64)
    if len(x) < 8:
        return False
    a, b = x - x.mean(0), y - y.mean(0)
    angle = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    c, s = np.cos(angle), np.sin(angle)
    off = np.sort(np.linalg.norm(b - a @ np.array([[c, s], [-s, c]]), axis=1))
    return bool(off[-8] > 0.30 * field.pitch_px)
