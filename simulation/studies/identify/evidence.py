"""Numbers from probes about a gel: its shear under a press, its release, and its bulge under a grip.

Two presses until slip, turned so that they touch on both sides, are made at each of two grips; the other probes are
those of the wiring check. By symmetry both fingers and both sides show the same: their fields are superposed.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
AT = (0, 1, 2, 4, 7, 10, 14, 19)
"""Steps of depth at which the motion is read; for a press that ended before, its end."""
EARLY, LATE = 2, -1
CORE = slice(3, 10)
"""Rows and columns of the lattice that lie within the pad's middle."""
NOISE_MM, NOISE_PX = 3e-3, 0.05


@dataclass(frozen=True, slots=True)
class Touch:
    """Observations of one probe. ``steps`` [n, 2, rows, columns, 3] are those of depth, in mm: see `DepthSteps`.

    ``markers_px`` [2, marker rows, marker columns, 2]: marker positions before the descent, NaN where not found;
    ``x_mm`` and ``yaw_deg``: its initial error, ``grip_n``: the fingers' force.
    """

    x_mm: float
    yaw_deg: float
    grip_n: float
    speed_mm_s: float
    steps: Floats
    markers_px: Floats


def numbers_of(
    signs: Sequence[Touch], presses: Mapping[float, Sequence[Touch]], size_mm: tuple[float, float]
) -> Floats:
    """All numbers that the posterior reads; ``presses`` by grip, the cell's own first."""
    (own, firm), (other, light) = presses.items()
    conditions = np.log([own, other, *size_mm, firm[0].speed_mm_s])
    parts = [conditions, _sheared(signs)]
    for made in (firm, light):
        parts.append(_sheared(made))
        parts.append(_profiles(made))
    parts.append(_bulged(firm, light))
    return np.concatenate(parts)


def _folded(touch: Touch) -> Floats:
    """Both fingers' steps [n, rows, columns, 2] in mm, superposed, as the left finger sees a push at +x."""
    right_side = touch.x_mm > 0.0 or (touch.x_mm == 0.0 and touch.yaw_deg > 0.0)
    fields = np.where(touch.steps[..., 2:] > 0.0, touch.steps[..., :2], np.nan)
    turned = fields[:, :, :, ::-1] * (-1.0, 1.0)
    both = np.stack([fields[:, 0], turned[:, 1]] if right_side else [turned[:, 0], fields[:, 1]])
    return np.asarray(np.nanmean(both, 0))


def _together(touches: Sequence[Touch]) -> list[Floats]:
    return [_folded(one) for one in touches if len(one.steps)]


def _sheared(touches: Sequence[Touch]) -> Floats:
    """Motion, turn and unevenness of the pad's middle over depth, and the final depth."""
    rows = []
    for field in _together(touches):
        core = field[[min(at, len(field) - 1) for at in AT]][:, CORE, CORE]
        motion = -np.nanmean(core[..., 1], (1, 2))
        turn = np.nanmean(np.diff(core[..., 1], axis=2), (1, 2))
        flat = core - np.nanmean(core, (1, 2), keepdims=True)
        uneven = np.sqrt(np.nanmean(np.square(flat).sum(-1), (1, 2)))
        rows.append(
            np.concatenate([_log(motion, NOISE_MM), _log(turn, 1e-3), _log(uneven, NOISE_MM), [len(field) / 20.0]])
        )
    return np.asarray(np.mean(rows, 0))


def _profiles(touches: Sequence[Touch]) -> Floats:
    """Decrease of the motion towards the pad's edges, early and at the end: along it up and down, and sideways."""
    rows = []
    for field in _together(touches):
        for at in (min(EARLY, len(field) - 1), LATE):
            moved = -field[at, :, :, 1]
            middle = max(float(np.nanmean(moved[CORE, CORE])), NOISE_MM)
            across = np.nanmean(moved[CORE], 0)
            rows.append(np.concatenate([np.nanmean(moved[:, CORE], 1), 0.5 * (across + across[::-1])[:7]]) / middle)
    return np.concatenate([np.mean(rows[0::2], 0), np.mean(rows[1::2], 0)])


def _bulged(firm: Sequence[Touch], light: Sequence[Touch]) -> Floats:
    """Additional outward motion of the markers under the firmer grip: by rows and by columns, from the middle out."""
    grown = np.nanmean([one.markers_px for one in firm], 0) - np.nanmean([one.markers_px for one in light], 0)
    down = np.nanmean(grown[..., 1], (0, 2))
    side = np.nanmean(grown[0, ..., 0] - grown[1, :, ::-1, 0], 0)
    return np.concatenate([_log(half, NOISE_PX) for half in (_odd(down), _odd(side))])


def _odd(line: Floats) -> Floats:
    return 0.5 * (line - line[::-1])[: len(line) // 2]


def _log(values: Floats, least: float) -> Floats:
    """Signed logarithm of values, linear below the noise level."""
    return np.asarray(np.sign(values) * np.log1p(np.abs(values) / least), np.float64)
