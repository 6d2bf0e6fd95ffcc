"""Motion of a rigid patch in the image plane: exact rotation, translation, optionally a uniform scale."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
MIN_NODES = 4
_LEAD = 4.0
MIN_SPREAD = 0.3  # pitch; below this standard deviation of the nodes across their thinnest direction no fit is made


@dataclass(frozen=True, slots=True)
class Motion:
    """``y = scale * R(angle_rad) (x - pivot_px) + pivot_px + shift_px``: x before, y after, in image px (v down)."""

    angle_rad: float
    scale: float
    pivot_px: Float64
    shift_px: Float64

    def apply(self, points: Float64) -> Float64:
        """Points [..., 2] after the motion."""
        c, s = self.scale * np.cos(self.angle_rad), self.scale * np.sin(self.angle_rad)
        x, y = points[..., 0] - self.pivot_px[0], points[..., 1] - self.pivot_px[1]
        moved = np.empty_like(points, np.float64)
        moved[..., 0] = c * x - s * y + self.pivot_px[0] + self.shift_px[0]
        moved[..., 1] = s * x + c * y + self.pivot_px[1] + self.shift_px[1]
        return moved


def still(pivot: Float64) -> Motion:
    return Motion(0.0, 1.0, pivot, np.zeros(2))


def fit_motion(before: Float64, after: Float64, weights: Float64, pitch: float, *, scale: bool) -> Motion | None:
    """Weighted least-squares motion of points [n, 2] (closed form, Umeyama 1991 in the plane), or None.

    None stands for a degenerate set: fewer than four points with weight, or points (nearly) on one line.
    """
    total = float(weights.sum())
    if np.count_nonzero(weights > 1e-3 * weights.max(initial=1e-12)) < MIN_NODES or total <= 0:
        return None
    pivot = weights @ before / total
    target = weights @ after / total
    x, y = before - pivot, after - target
    uu, uv, _, vv = ((x * weights[:, None]).T @ x / total).ravel().tolist()
    thinnest = (uu + vv) / 2 - math.hypot((uu - vv) / 2, uv)  # the smaller eigenvalue
    if not thinnest > (MIN_SPREAD * pitch) ** 2:
        return None
    dot = float(weights @ _dot(x, y))
    cross = float(weights @ (x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0]))
    size = float(np.hypot(dot, cross) / (weights @ _dot(x, x))) if scale else 1.0
    if not np.isfinite([dot, cross, size]).all() or size <= 0:
        return None
    return Motion(float(np.arctan2(cross, dot)), size, pivot, target - pivot)


def refine(
    before: Float64, after: Float64, start: Motion, base: Float64, tolerance: float, pitch: float, *, scale: bool
) -> Motion | None:
    """Iteratively reweighted fit (Geman-McClure) from ``start``; ``base`` [n] weights select the points that count.

    A slipping node always lags and never leads, so points ahead of the motion keep their weight up to ``_LEAD`` times
    the tolerance: the fit follows the sticking points even when most have begun to lag.
    """
    motion: Motion | None = start
    for _ in range(3):
        assert motion is not None
        carried = motion.apply(before)
        off, way = after - carried, carried - before
        reach = np.where(_dot(off, way) > 0, _LEAD * tolerance, tolerance)
        weights = base / np.square(1 + _dot(off, off) / np.square(reach))
        motion = fit_motion(before, after, weights, pitch, scale=scale)
        if motion is None:
            return None
    return motion


def _dot(a: Float64, b: Float64) -> Float64:
    return np.asarray(a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1])


def length(off: Float64) -> Float64:
    """Lengths [...] of vectors [..., 2]; several times as fast as numpy's norm, bit for bit equal."""
    return np.asarray(np.sqrt(_dot(off, off)))


def moving_patch(before: Float64, after: Float64, valid: NDArray[np.bool_], tolerance: float, pitch: float) -> Motion:
    """The rigid motion of the largest moving patch of the grid, ``before``/``after`` [rows, cols, 2].

    Every small window of the grid proposes its own motion. The one that explains the most movement wins, so a resting
    majority outside the contact does not. Ties and grids at rest give no motion. Non-finite nodes count as invalid.
    """
    valid = valid & np.isfinite(before).all(-1) & np.isfinite(after).all(-1)
    before, after = np.where(valid[..., None], before, 0.0), np.where(valid[..., None], after, 0.0)
    flat_before, flat_after, flat_valid = before.reshape(-1, 2), after.reshape(-1, 2), valid.reshape(-1)
    pivot = flat_before.mean(0)
    angles, shifts, centres = _window_motions(before - pivot, after - pivot, valid)
    if len(angles) == 0:
        return still(pivot)
    x = flat_before - pivot
    c, s = np.cos(angles)[:, None], np.sin(angles)[:, None]
    u, v = x[None, :, 0] - centres[:, :1], x[None, :, 1] - centres[:, 1:]
    to, y = centres + shifts, flat_after - pivot
    p, q = c * u - s * v + to[:, :1], s * u + c * v + to[:, 1:]
    residual, moved = (np.sqrt(np.square(p - z[:, 0]) + np.square(q - z[:, 1])) for z in (y, x))
    follows = flat_valid & (residual < tolerance + 0.1 * np.minimum(moved, pitch))
    score = np.where(follows, np.minimum(moved, pitch), 0).sum(1)
    best = int(score.argmax())
    return Motion(float(angles[best]), 1.0, centres[best] + pivot, shifts[best])


def _window_motions(x: Float64, y: Float64, valid: NDArray[np.bool_]) -> tuple[Float64, Float64, Float64]:
    """Rigid motion of each window of the grid: angle [h], shift [h, 2] of its centroid [h, 2]; moments by box sums."""
    side = 5 if min(valid.shape) >= 9 else 3
    w = valid.astype(np.float64)
    channels = np.stack(
        [
            w,
            w * x[..., 0],
            w * x[..., 1],
            w * y[..., 0],
            w * y[..., 1],
            w * (x * y).sum(-1),
            w * (x[..., 0] * y[..., 1] - x[..., 1] * y[..., 0]),
        ],
        -1,
    )
    halves = [
        cv2.boxFilter(
            np.ascontiguousarray(part), cv2.CV_64F, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT
        )
        for part in (channels[..., :4], channels[..., 4:])
    ]
    sums = np.concatenate(halves, -1)[side // 2 :: 2, side // 2 :: 2].reshape(-1, 7)
    sums = sums[sums[:, 0] >= 0.7 * side * side]
    n = sums[:, :1]
    mx, my = sums[:, 1:3] / n, sums[:, 3:5] / n
    dot = sums[:, 5] - n[:, 0] * (mx * my).sum(1)
    cross = sums[:, 6] - n[:, 0] * (mx[:, 0] * my[:, 1] - mx[:, 1] * my[:, 0])
    return np.asarray(np.arctan2(cross, dot)), np.asarray(my - mx), np.asarray(mx)


def carried_px(displacement: Float64, may: NDArray[np.bool_]) -> float:
    """Largest motion of the gel, in px: the tenth largest 3 x 3 mean of the displacement."""
    weight = may.astype(np.float64)
    stack = np.dstack([displacement * weight[..., None], weight])
    total = cv2.boxFilter(stack, cv2.CV_64F, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
    mean = np.hypot(total[..., 0], total[..., 1]) / np.maximum(total[..., 2], 1)
    return float(np.sort(mean, axis=None)[-min(10, mean.size)])
