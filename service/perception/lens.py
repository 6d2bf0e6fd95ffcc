"""Distortions of the straight rows of a marker grid: a lens with radial distortion, and a gel that is not flat.

Lens: a point at distance r (in shares of ``scale_px``) from ``centre_px`` appears nearer or further than in a pinhole
camera: ideal - centre = (raw - centre) (1 + k1 r^2 + k2 r^4), with r of the raw point (the inverse form of Brown 1971,
which needs no iteration from the raw frame).

Warp: the remainder after lens and homography (a gel glued unevenly, a curved skin, a mirror) as Legendre polynomials of
the place in the rectified frame.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.polynomial.legendre import legvander2d
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
_STEPS = 30
_CLOSE = 1e-7  # of the warp's extent
_STEEPEST = 0.5  # change of a warp, or of a radius, from which two points could coincide


@dataclass(frozen=True, slots=True)
class Lens:
    """``centre_px`` (u, v) in the raw frame, ``scale_px`` the distance at which r is 1, ``k1`` and ``k2`` plain."""

    centre_px: tuple[float, float]
    scale_px: float
    k1: float
    k2: float

    def ideal(self, raw: Float64) -> Float64:
        """Points [..., 2] as in a pinhole camera, from their places in the raw frame, both in px."""
        off = raw - np.asarray(self.centre_px)
        squared = np.square(off / self.scale_px).sum(-1, keepdims=True)
        return np.asarray(self.centre_px + off * (1 + squared * (self.k1 + self.k2 * squared)))

    def raw(self, ideal: Float64) -> Float64:
        """The inverse of :meth:`ideal`, by Newton on the radius; correct where the lens is :meth:`one_to_one`."""
        off = ideal - np.asarray(self.centre_px)
        goal = np.linalg.norm(off / self.scale_px, axis=-1, keepdims=True)
        r = goal.copy()
        for _ in range(_STEPS):
            slope = 1 + r**2 * (3 * self.k1 + 5 * self.k2 * r**2)
            r -= (r * (1 + r**2 * (self.k1 + self.k2 * r**2)) - goal) / np.maximum(slope, _STEEPEST)
            r = np.clip(r, 0, 2 * goal + 1)
        return np.asarray(self.centre_px + off * np.where(goal > 0, r / np.maximum(goal, 1e-12), 1))

    def one_to_one(self, width_px: int, height_px: int) -> bool:
        """Whether no two points of a raw frame of this size have the same ideal point."""
        values = np.array([*self.centre_px, self.scale_px, self.k1, self.k2])
        if not (np.isfinite(values).all() and self.scale_px > 0):
            return False
        corners = np.array([(0, 0), (width_px, 0), (width_px, height_px), (0, height_px)], np.float64)
        far = float(np.linalg.norm((corners - self.centre_px) / self.scale_px, axis=1).max())
        r = np.linspace(0, far, 200)
        return bool((1 + r**2 * (3 * self.k1 + 5 * self.k2 * r**2)).min() > _STEEPEST)


@dataclass(frozen=True, slots=True)
class Warp:
    """Adds to points the polynomials ``coefficients`` [2, terms] of their place between ``low`` and ``high`` [2].

    Beyond these corners the correction of the nearest point between them applies. ``terms`` is the number of a full
    order: 3, 6, 10, 15, 21 or 28.
    """

    low: Float64
    high: Float64
    coefficients: Float64

    def apply(self, points: Float64) -> Float64:
        """Points [n, 2] with their corrections, same unit."""
        return np.asarray(points + self.terms(points, self.order) @ self.coefficients.T)

    def undo(self, points: Float64) -> Float64:
        """The inverse of :meth:`apply`, by fixed point; correct where the warp is :meth:`one_to_one`."""
        before = points
        for _ in range(_STEPS):
            last, before = before, points - self.terms(before, self.order) @ self.coefficients.T
            if np.abs(before - last).max(initial=0) < _CLOSE * float((self.high - self.low).max()):
                break
        return before

    @property
    def order(self) -> int:
        """Order of the polynomials."""
        return order_of(self.coefficients.shape[1])

    def terms(self, points: Float64, order: int) -> Float64:
        """The polynomials [n, terms] at points [n, 2]."""
        place = np.clip(2 * (points - self.low) / (self.high - self.low) - 1, -1, 1)
        full = legvander2d(place[:, 0], place[:, 1], [order, order])
        i, j = np.divmod(np.arange((order + 1) ** 2), order + 1)
        return np.asarray(full[:, i + j <= order])

    def one_to_one(self) -> bool:
        """Whether no two points coincide after the warp."""
        if not np.isfinite(self.coefficients).all() or not (self.high > self.low).all():
            return False
        count = 25
        axes = [np.linspace(low, high, count) for low, high in zip(self.low, self.high, strict=True)]
        grid = np.stack(np.meshgrid(*axes), -1)
        moved = self.apply(grid.reshape(-1, 2)).reshape(grid.shape) - grid
        step = (self.high - self.low) / (count - 1)
        slopes = [np.linalg.norm(np.diff(moved, axis=1 - k), axis=-1).max() / step[k] for k in range(2)]
        return bool(max(slopes) < _STEEPEST)


@dataclass(frozen=True, slots=True)
class Projection:
    """Raw px -> lens -> homography [3, 3] -> warp -> the markers' plane; ``lens``, ``warp`` None if not needed."""

    homography: Float64
    lens: Lens | None = None
    warp: Warp | None = None

    def plane(self, raw: Float64) -> Float64:
        """Places of raw points [n, 2] in the plane of the markers, [n, 2]."""
        flat = transformed(self.homography, raw if self.lens is None else self.lens.ideal(raw))
        return flat if self.warp is None else self.warp.apply(flat)

    def raw(self, plane: Float64) -> Float64:
        """The inverse of :meth:`plane`."""
        flat = plane if self.warp is None else self.warp.undo(plane)
        ideal = transformed(np.asarray(np.linalg.inv(self.homography), np.float64), flat)
        return ideal if self.lens is None else self.lens.raw(ideal)

    def scaled(self, scale: float, shift: Float64) -> "Projection":
        """The projection whose plane coordinates are those of this one times ``scale`` plus ``shift`` [2]."""
        change = np.array([[scale, 0, shift[0]], [0, scale, shift[1]], [0, 0, 1.0]])
        warp = self.warp
        if warp is not None:
            warp = Warp(warp.low * scale + shift, warp.high * scale + shift, warp.coefficients * scale)
        return Projection(change @ self.homography, self.lens, warp)

    def moved(self, change: Float64) -> "Projection":
        """The projection of a raw frame to which the similarity ``change`` [3, 3] takes the points of this one's."""
        lens = self.lens
        if lens is not None:
            ((u, v),) = transformed(change, np.array([lens.centre_px])).tolist()
            lens = Lens((u, v), lens.scale_px * scale_of(change), lens.k1, lens.k2)
        return Projection(self.homography @ np.linalg.inv(change), lens, self.warp)


def transformed(matrix: Float64, points: Float64) -> Float64:
    """Points [n, 2] after a homography [3, 3]."""
    return np.asarray(cv2.perspectiveTransform(np.asarray(points, np.float64).reshape(-1, 1, 2), matrix)[:, 0])


def scale_of(similarity: Float64) -> float:
    """The factor by which a similarity [3, 3] magnifies."""
    return float(np.hypot(*similarity[0, :2]))


def order_of(terms: int) -> int:
    """The order of a full set of ``terms`` polynomials in two variables. Raises ValueError if there is none."""
    for order in range(1, 7):
        if (order + 1) * (order + 2) // 2 == terms:
            return order
    raise ValueError(f"warp has {terms} terms, expected 3, 6, 10, 15, 21 or 28")
