"""Homography, lens and warp that map markers in a raw frame to the nodes of a regular grid."""

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from service.perception.lens import Float64, Lens, Projection, Warp, transformed

_FAR = 2.7  # medians; a marker further off its node (3.2 sigma) is displaced, damaged or false
_ORDER, _SAMPLES, _PAYS = 6, 3, 0.97  # of the warp: highest order, markers per term, required gain of the next order


def settled(
    raw: Float64, cells: NDArray[np.intp], size: tuple[int, int], terms: tuple[int, ...]
) -> tuple[Projection | None, NDArray[np.intp], Float64]:
    """The model, and the markers that fit it."""
    model = _best_model(raw, cells, size, terms)
    for _ in range(3):
        if model is None:
            break
        off = np.linalg.norm(model.plane(raw) - cells, axis=1)
        keep = off < max(_FAR * float(np.median(off)), 0.02)
        if keep.all() or keep.sum() < 25:
            break
        raw, cells = raw[keep], cells[keep]
        model = _best_model(raw, cells, size, terms)
    return model, cells, raw


def _best_model(
    raw: Float64, cells: NDArray[np.intp], size: tuple[int, int], terms: tuple[int, ...]
) -> Projection | None:
    """The lens with the least BIC, and the warp with the best prediction."""
    best, least = None, np.inf
    for count in terms:
        model = _model_of(raw, cells, size, count)
        if model is None:
            continue
        squares = float(np.square(model.plane(raw) - cells).sum())
        n = 2 * len(raw)
        score = n * np.log(squares / n + 1e-12) + (8 + count) * np.log(n)
        if score < least:
            best, least = model, score
    if best is None:  # false spots around the grid, as at a dark edge of the gel, bend a lens until it folds the frame
        best = _model_of(raw, cells, size, 0)
    return best if best is None else Projection(best.homography, best.lens, _warp(best.plane(raw), cells))


def _warp(flat: Float64, cells: NDArray[np.intp]) -> Warp | None:
    """The warp of grid points ``flat`` [n, 2] to ``cells`` with the best prediction of left-out markers, or None.

    Each marker is left out in turn (for least squares in closed form, by the leverages); it must gain a few per cent.
    """
    off = cells - flat
    low, high = cells.min(0).astype(np.float64), cells.max(0).astype(np.float64)
    best, least = None, _PAYS * float(np.square(off).sum())
    for order in range(2, _ORDER + 1):
        terms = Warp(low, high, np.zeros((2, 3))).terms(flat, order)
        if _SAMPLES * terms.shape[1] > len(flat):
            break
        q, r = np.linalg.qr(terms)
        coefficients = np.linalg.solve(r, q.T @ off)
        left_out = (off - terms @ coefficients) / (1 - np.square(q).sum(1))[:, None]
        warp = Warp(low, high, coefficients.T)
        if (squares := float(np.square(left_out).sum())) < least and warp.one_to_one():
            best, least = warp, _PAYS * squares
    return best


def _model_of(raw: Float64, cells: NDArray[np.intp], size: tuple[int, int], terms: int) -> Projection | None:
    """Least squares over homography and the first ``terms`` of k1, k2, centre u, v; None if it fails or folds.

    For a given lens the homography follows, so Gauss-Newton runs over the radial terms alone (variable projection).
    """
    width, height = size
    scale = float(np.hypot(width, height)) / 2

    def lens_of(p: Float64) -> Lens:
        full = np.concatenate([p, np.zeros(4 - len(p))])
        centre = ((width - 1) / 2 + float(full[2]) * scale, (height - 1) / 2 + float(full[3]) * scale)
        return Lens(centre, scale, float(full[0]), float(full[1]))

    def off_of(p: Float64) -> tuple[Float64, Float64] | None:
        ideal = lens_of(p).ideal(raw) if len(p) else raw
        matrix, _ = cv2.findHomography(ideal, cells.astype(np.float64))
        if matrix is None or not np.isfinite(matrix).all():
            return None
        return (transformed(np.asarray(matrix), ideal) - cells).ravel(), np.asarray(matrix, np.float64)

    p = _least_squares(lambda q: None if (residual := off_of(q)) is None else residual[0], terms)
    best = None if p is None else off_of(p)
    if p is None or best is None or (terms and not lens_of(p).one_to_one(width, height)):
        return None
    return Projection(best[1], lens_of(p) if terms else None)


def _least_squares(off: Callable[[Float64], Float64 | None], terms: int) -> Float64 | None:
    """The parameters [terms] that minimise the squares of ``off``, by Levenberg and Marquardt from zero."""
    p, damping = np.zeros(terms), 1e-3
    now = off(p)
    for _ in range(12 if terms else 0):
        if now is None:
            return None
        moved = [off(p + step) for step in 1e-4 * np.eye(terms)]
        if any(one is None for one in moved):
            return None
        slope = np.stack([(np.asarray(one) - now) / 1e-4 for one in moved], 1)
        normal = slope.T @ slope
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-9), -slope.T @ now)
        tried = off(p + step)
        if tried is None or tried @ tried >= now @ now:
            damping *= 30
            continue
        small = tried @ tried > (1 - 1e-4) * (now @ now)
        p, now, damping = p + step, tried, damping / 5
        if small:
            break
    return p
