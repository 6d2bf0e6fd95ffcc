"""Matches markers from frame to frame: nearest spot near the prediction, checked against the grid around it.

A regular grid that jumps by nearly a pitch looks like one that moved a little in the opposite direction. The grid's
border, its gaps and the small irregularities of its nodes distinguish the two; :func:`misfit` weighs all three.
"""

from dataclasses import dataclass
from operator import itemgetter

import cv2
import numpy as np
from numpy.typing import NDArray

from service.perception.markers.field import (
    MOST_SCATTER,
    BoolArray,
    FloatArray,
    neighbour_mean,
    neighbour_median,
    scatter,
)
from service.perception.markers.lattice import fill_gaps, flood, lattice_basis, neighbours

_SEARCH = 0.46  # pitch; a node's spot lies within this of its prediction
_TEAR = 0.5  # pitch; a node that deviates this much from its neighbours is a wrong match
_FLAT = 1e-9  # of the spread squared; nodes with a smaller spread across lie on one line
_CAP = MOST_SCATTER  # cost of a node without a spot, or of one five sigma off
_BEYOND = 1e6  # px
_WINDOW = np.ones((3, 3), np.uint8)
_LEAST_N = 9  # spots required for a placement
_BETTER = 0.05  # least difference of misfit between two placements that counts
_STRAY = 0.5 * _CAP  # of a spot without a node
_SWEEPS_N = 12
_AT_HOME = 0.2  # pitch between two frames, below which a node stands still
_STEPS = np.array(
    sorted(((col, row) for row in range(-3, 4) for col in range(-3, 4)), key=lambda step: np.hypot(*step))
)
_AROUND = np.array([(row, column) for row in (-1, 0, 1) for column in (-1, 0, 1)])
_NEAR, _FAR = (_STEPS[chosen] for chosen in (np.abs(_STEPS).max(1) <= 2, np.abs(_STEPS).max(1) == 3))


@dataclass(frozen=True, slots=True)
class Match:
    """Positions ``xy_px`` [rows, cols, 2] of the nodes, ``valid`` where a spot was found, ``misfit`` per node seen.

    ``scatter``: the mean of `field.scatter` over the valid nodes.
    """

    xy_px: FloatArray
    valid: BoolArray
    misfit: float
    scatter: float
    torn_n: int
    spot: NDArray[np.intp]  # index of the candidate, -1 where none


@dataclass(frozen=True, slots=True)
class View:
    """The image's extent and the margin within which a spot is not completely visible."""

    width_px: int
    height_px: int
    margin_px: float

    def contains(self, xy: FloatArray) -> BoolArray:
        """Where a marker at ``xy`` [..., 2] would be visible."""
        inside: BoolArray = self.room_px(xy) > self.margin_px
        return inside

    def room_px(self, xy: FloatArray) -> FloatArray:
        """Distance of ``xy`` [..., 2] inside the image's border, negative outside."""
        far = np.array([self.width_px - 1, self.height_px - 1], np.float32)
        room = np.minimum(xy, far - xy)
        return np.asarray(np.minimum(room[..., 0], room[..., 1]))


def nearest_spot(predicted: FloatArray, points: FloatArray, reach: float) -> NDArray[np.intp]:
    """Index [rows, cols] of the spot nearest to each prediction within ``reach`` px, -1 if none; no spot twice.

    There is at least one spot.
    """
    rows, cols = predicted.shape[:2]
    low = np.minimum(points.min(0), predicted.reshape(-1, 2).min(0)) - 2 * reach
    cell = np.floor((points - low) / reach).astype(np.intp)
    node = np.floor((predicted.reshape(-1, 2) - low) / reach).astype(np.intp)
    shape = np.maximum(cell.max(0), node.max(0)) + 2
    table = np.full((shape[1], shape[0]), -1, np.intp)
    order = np.arange(len(points))[::-1]  # strongest last, so that it stays where two share a cell
    table[cell[order, 1], cell[order, 0]] = order
    around = table.ravel()[(node[:, 1] * shape[0] + node[:, 0]) + (_AROUND[:, :1] * shape[0] + _AROUND[:, 1:])]
    off_u, off_v = points[:, 0][around] - predicted[..., 0].ravel(), points[:, 1][around] - predicted[..., 1].ravel()
    squared = np.where(around >= 0, off_u * off_u + off_v * off_v, np.float32(np.inf))
    best, rank = squared.argmin(0), np.arange(rows * cols)
    nearest, cost = around[best, rank], squared[best, rank]
    nearest[cost >= reach * reach] = -1
    hit = np.flatnonzero(nearest >= 0)
    claimed = nearest[hit]
    if hit.size and np.bincount(claimed).max() > 1:  # a spot claimed twice belongs to the nearer node
        claim = np.full(len(points), np.inf)
        np.minimum.at(claim, claimed, cost[hit])
        nearest[hit] = np.where(cost[hit] <= claim[claimed], claimed, -1)
    return np.asarray(nearest.reshape(rows, cols))


def match(
    predicted: FloatArray, rest: FloatArray, points: FloatArray, pitch: float, view: View, previous: FloatArray
) -> Match:
    """Match nodes predicted at ``predicted`` px to spots; all arrays [rows, cols, 2].

    ``rest`` is the undeformed grid and ``previous`` the last positions, the reference of the smoothness check.
    """
    spot = nearest_spot(predicted, points, _SEARCH * pitch)
    return score_match(spot, rest, points, pitch, view, previous)


def score_match(
    spot: NDArray[np.intp], rest: FloatArray, points: FloatArray, pitch: float, view: View, previous: FloatArray
) -> Match:
    """Turn an assignment of spots to nodes into a :class:`Match`, dropping torn nodes and filling gaps."""
    valid = spot >= 0
    xy = np.where(valid[..., None], points[spot], previous)
    displacement = xy - _affine(rest, xy, valid)  # in a twisted grid, neighbours move very differently
    torn = _torn(displacement, valid, _TEAR * pitch)
    valid = valid & ~torn
    step = xy - previous
    smooth = neighbour_mean(step, valid)
    guess = previous + smooth
    xy = np.where(valid[..., None], xy, guess).astype(np.float32)
    scattered = scatter(step - smooth, pitch)
    counts = view.contains(xy) | valid
    cost = np.where(valid, scattered, _CAP)[counts].sum()
    hits_n = int(np.count_nonzero(valid))
    total = max(1, int(np.count_nonzero(counts)))
    misfit = float((cost + _STRAY * (len(points) - hits_n)) / total)
    mean_scatter = float(scattered[valid].sum()) / max(1, hits_n)
    return Match(xy, valid, misfit, mean_scatter, int(torn.sum()), np.where(valid, spot, -1))


def _torn(displacement: FloatArray, valid: BoolArray, limit: float) -> BoolArray:
    """Which valid nodes [rows, cols] moved further than ``limit`` from the median of their neighbours."""
    moved = displacement[valid]
    if not len(moved) or np.hypot(*np.ptp(moved, axis=0)) <= limit:
        return np.zeros_like(valid)  # a median lies between the extremes
    most, least = (np.where(valid[..., None], displacement, np.float32(end)) for end in (-_BEYOND, _BEYOND))
    reach = np.maximum(cv2.dilate(most, _WINDOW) - displacement, displacement - cv2.erode(least, _WINDOW))
    if not (valid & (_squared(reach) > limit**2)).any():
        return np.zeros_like(valid)
    typical, around = neighbour_median(displacement, valid)
    return np.asarray(valid & (around >= 3) & (_squared(displacement - typical) > limit**2), np.bool_)


def _squared(off: FloatArray) -> FloatArray:
    """Squared length of vectors [..., 2]."""
    return np.asarray(off[..., 0] * off[..., 0] + off[..., 1] * off[..., 1])


def _affine(rest: FloatArray, xy: FloatArray, valid: BoolArray) -> FloatArray:
    """``rest`` moved by the affine map that best fits the valid nodes; ``rest`` itself if there are few."""
    known = rest[valid]
    if len(known) < 12:
        return rest
    middle = known.mean(0)
    x = np.ones((len(known), 3))
    x[:, :2] = known - middle
    normal = x.T @ x
    uu, vv, uv = normal[0, 0], normal[1, 1], normal[0, 1]
    if uu * vv - uv * uv <= _FLAT * (uu + vv) ** 2:  # all on one line
        return rest
    linear = np.linalg.solve(normal, x.T @ xy[valid])
    carried = (rest - middle).reshape(-1, 2) @ linear[:2] + linear[2]
    return np.asarray(carried.reshape(rest.shape), np.float32)


def reindex(
    points: FloatArray, rest: FloatArray, pitch: float, view: View, previous: FloatArray, prior: Match, calm: float
) -> Match:
    """Match by topology alone: link the spots to a grid, then find its shift in whole steps from the old one.

    Survives jumps of up to three pitches, fast twists and bumps whose middle moved by more than a pitch. Returns the
    best of this and ``prior``. ``previous`` [rows, cols, 2] decides between placements that fit equally: the least
    motion wins. A misfit below ``calm`` is that of a correct match: one step off leaves a border row without spots.
    """
    like = np.stack([np.diff(previous, axis=1).mean((0, 1)), np.diff(previous, axis=0).mean((0, 1))])
    basis = lattice_basis(points, like)
    if basis is None:
        return prior

    def place(spot: NDArray[np.intp]) -> tuple[float, Match]:
        rival = score_match(spot, rest, points, pitch, view, previous)
        return rival.misfit + _motion(rival, previous, pitch), rival

    near = neighbours(points)
    grown = place(_grown(points, near, basis, previous, prior, pitch))[1]
    bridged = place(nearest_spot(_bridged(grown, previous), points, _SEARCH * pitch))
    score, best = min((prior.misfit + _motion(prior, previous, pitch), prior), bridged, key=itemgetter(0))
    to_beat = score - _BETTER
    seed = int(np.square(points - previous.reshape(-1, 2).mean(0)).sum(1).argmin())
    # The grid cell of the seed under least motion; placements up to two steps off compete with it. Where none of them
    # fits a grid that is almost complete, it has jumped by three.
    row_col = divmod(int(np.square(previous.reshape(-1, 2) - points[seed]).sum(-1).argmin()), rest.shape[1])
    index, reached = flood(points, near, basis, np.array([seed]), np.array([row_col[::-1]]))
    spot_of = np.flatnonzero(reached)
    for steps in (_NEAR, _FAR):
        if best.misfit < calm or reached.sum() < _LEAST_N:
            break
        for step, fit_n in zip(steps, _fit_n(index[reached], steps, rest.shape[:2]), strict=True):
            least = _STRAY * (len(points) - fit_n) / rest[..., 0].size  # misfit if everything else were perfect
            if fit_n < _LEAST_N or least >= to_beat:
                continue
            score, rival = place(_placed(index[reached] + step, spot_of, rest.shape[:2]))
            if score < to_beat:
                best, to_beat = rival, score - _BETTER
        if reached.sum() < 0.6 * rest[..., 0].size:
            break
    if best is prior:
        return prior
    # The flood stops at gaps; spots beyond are found by extrapolating a smooth surface through the rest.
    spread, _ = fill_gaps(best.xy_px, best.valid)
    full = match(spread, rest, points, pitch, view, previous)
    return full if full.valid.sum() > best.valid.sum() else best


def _grown(
    points: FloatArray,
    near: NDArray[np.intp],
    basis: FloatArray,
    previous: FloatArray,
    prior: Match,
    pitch: float,
) -> NDArray[np.intp]:
    """Spots of the nodes [rows, cols], -1 elsewhere, linked from the nodes that stand still and whose neighbours do.

    So a bulge is entered from all sides, and no row is lost where the gel is stretched.
    """
    still = prior.valid & (_squared(prior.xy_px - previous) < (_AT_HOME * pitch) ** 2)
    firm = cv2.erode(still.astype(np.uint8), _WINDOW) > 0
    index, reached = flood(points, near, basis, prior.spot[firm], np.argwhere(firm)[:, ::-1])
    return _placed(index[reached], np.flatnonzero(reached), prior.valid.shape)


def _bridged(match: Match, previous: FloatArray) -> FloatArray:
    """Positions [rows, cols, 2] of all nodes; those without a spot have moved as those around them, on average."""
    moved = match.xy_px - previous
    step, known = np.where(match.valid[..., None], moved, np.float32(0.0)), match.valid
    for _ in range(_SWEEPS_N):
        around = neighbour_mean(step, known)
        known = known | (cv2.dilate(known.astype(np.uint8), _WINDOW) > 0)
        step = np.where(match.valid[..., None], moved, around)
    return np.asarray(previous + step, np.float32)


def _fit_n(cells: NDArray[np.intp], steps: NDArray[np.intp], shape: tuple[int, ...]) -> list[int]:
    """How many of the cells [n, 2] (column, row) lie on a grid [rows, cols] after each of the steps [m, 2]."""
    moved = cells + steps[:, None]
    fit_n: list[int] = ((moved >= 0) & (moved < shape[::-1])).all(-1).sum(-1).tolist()
    return fit_n


def _placed(cells: NDArray[np.intp], spot_of: NDArray[np.intp], shape: tuple[int, ...]) -> NDArray[np.intp]:
    """Spots laid on the grid [rows, cols] at ``cells`` (column, row), -1 elsewhere."""
    fits = ((cells >= 0) & (cells < shape[::-1])).all(1)
    spot = np.full(shape, -1, np.intp)
    spot[cells[fits, 1], cells[fits, 0]] = spot_of[fits]
    return spot


def _motion(candidate: Match, previous: FloatArray, pitch: float) -> float:
    """A weak preference for little motion: half a point per pitch, of the 25 that a missing marker costs."""
    moved = np.linalg.norm(candidate.xy_px - previous, axis=-1)
    return float(0.5 * moved[candidate.valid].mean() / pitch) if candidate.valid.any() else _CAP
