"""Assigns spots to markers: candidates linked to a grid by their topology, without knowing its size or pitch."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from service.perception.markers.detect import Candidates, MarkerDetector
from service.perception.markers.field import BoolArray, FloatArray, median, neighbour_mean, scatter
from service.perception.markers.regular import bent_print

_STEPS = np.array([(1, 0), (-1, 0), (0, 1), (0, -1)])  # (column, row)
_SIGNS = np.array([[1.0], [-1.0]], np.float32)
_LINK = 0.33  # a neighbour lies within this share of a pitch from the place predicted by the last step
_AROUND = 12  # nearest spots among which a spot's neighbours in the grid are sought
_LEAST_PX = 32
_STREWN = 18.2  # mean scatter in 355 grids of noise: 18.7 at least; in 950 real frames, loaded ones too: 17.7 at most
DIAMETERS_PX = (4.0, 5.0, 6.5, 8.5, 11.0, 14.5, 19.0, 25.0)


@dataclass(frozen=True)
class Lattice:
    """A grid of markers: ``xy_px`` float32 [rows, cols, 2], finite everywhere, measured where ``detected``.

    ``basis_px`` [2, 2]: mean step to the next column and to the next row. ``diameter_px`` of the detector behind it.
    """

    xy_px: FloatArray
    detected: BoolArray
    basis_px: FloatArray
    diameter_px: float
    strength: float

    @cached_property
    def pitch_px(self) -> float:
        """Mean distance of neighbours in pixels."""
        return float(np.linalg.norm(self.basis_px, axis=1).mean())


def flood(
    points: FloatArray,
    near: NDArray[np.intp],
    basis: FloatArray,
    seeds: NDArray[np.intp],
    cells: NDArray[np.intp],
) -> tuple[NDArray[np.intp], BoolArray]:
    """Grid index (column, row) int [n, 2] of every point reachable by lattice steps, and which points are.

    It begins at the points ``seeds`` [m], whose index is ``cells`` [m, 2]; ``near`` are the points' `neighbours`.
    ``basis`` [2, 2] starts the local basis, which then follows the grid's deformation from node to node.
    """
    count = len(points)
    index = np.zeros((count, 2), np.intp)
    reached = np.zeros(count, np.bool_)
    local = np.repeat(basis[None].astype(np.float32), count, 0)
    taken = set(map(tuple, cells.tolist()))
    reached[seeds], index[seeds] = True, cells
    wave = seeds
    while wave.size:
        step = (local[wave][:, :, None] * _SIGNS).reshape(-1, len(_STEPS), 2)
        off = (points[wave][:, None] + step)[:, :, None] - points[near[wave]][:, None]
        squared = off[..., 0] ** 2 + off[..., 1] ** 2
        nearest = near[wave[:, None], squared.argmin(-1)].ravel()
        distance = squared.min(-1).ravel()
        reach = _LINK**2 * (step[..., 0] ** 2 + step[..., 1] ** 2).ravel()
        hits = np.flatnonzero((distance < reach) & ~reached[nearest])
        hits = hits[np.argsort(distance[hits])]
        hits = hits[_unclaimed(nearest[hits], index[wave[hits // 4]] + _STEPS[hits % 4], taken)]
        child, parent, way = nearest[hits], wave[hits // 4], hits % 4
        reached[child], index[child], local[child] = True, index[parent] + _STEPS[way], local[parent]
        gone = 0.5 * _STEPS[way].sum(1)[:, None] * (points[child] - points[parent])
        local[child, way // 2] = 0.5 * local[parent, way // 2] + gone
        wave = child
    return index, reached


def _unclaimed(points: NDArray[np.intp], cells: NDArray[np.intp], taken: set[tuple[int, ...]]) -> list[int]:
    """Which claims of a point [n] to a cell [n, 2] come first; their cells are added to ``taken``."""
    chosen, placed = [], set()
    for k, (point, cell) in enumerate(zip(points.tolist(), map(tuple, cells.tolist()), strict=True)):
        if point not in placed and cell not in taken:
            placed.add(point)
            taken.add(cell)
            chosen.append(k)
    return chosen


def neighbours(points: FloatArray) -> NDArray[np.intp]:
    """Indices [n, up to 12] of the spots around each: the grid's four neighbours are among them."""
    apart = (points[:, None, 0] - points[None, :, 0]) ** 2 + (points[:, None, 1] - points[None, :, 1]) ** 2
    np.fill_diagonal(apart, np.inf)
    return np.argpartition(apart, min(_AROUND, len(points)) - 1, axis=1)[:, :_AROUND]


def lattice_basis(points: FloatArray, like: FloatArray | None = None) -> FloatArray | None:
    """Typical steps to the next column and row, [2, 2], or None if the points hold no grid.

    The lattice is read modulo a quarter turn; ``like`` picks the quarter turn (default: columns to the right).
    """
    if len(points) < 9:
        return None
    apart_u, apart_v = (np.subtract.outer(along, along) for along in np.ascontiguousarray(points.T))
    length = np.sqrt(apart_u * apart_u + apart_v * apart_v)
    np.fill_diagonal(length, np.inf)
    steps = points[length.argmin(1)] - points
    pitch = float(median(np.linalg.norm(steps, axis=1)))
    near = np.abs(length - pitch) < 0.45 * pitch
    around = np.stack([apart_u[near], apart_v[near]], 1)
    angle = np.arctan2(around[:, 1], around[:, 0])
    quarter = float(np.angle(np.exp(4j * np.arctan2(steps[:, 1], steps[:, 0])).sum())) / 4
    start = 0.0 if like is None else float(np.arctan2(like[0, 1], like[0, 0]))
    turn = quarter + round((start - quarter) / (np.pi / 2)) * np.pi / 2
    basis = []
    for want in (turn, turn + np.pi / 2):
        off = np.abs(np.angle(np.exp(1j * (angle - want))))
        chosen = around[off < np.deg2rad(25)]
        if len(chosen) < 4:
            return None
        basis.append(median(chosen))
    return np.array(basis, np.float32)


def find_lattice(image: NDArray[np.uint8]) -> Lattice | None:
    """The marker grid of a frame at the best-fitting scale, or None if there is none of at least 5 x 5.

    The grid's columns must run within 40 deg of the image's, which must be at least 32 px wide and high. Takes about 20
    ms; run it once per recording. Linking the spots takes longest, so the most promising scale comes first.
    """
    best, merit = None, 0.0
    scales = DIAMETERS_PX if min(image.shape[:2]) >= _LEAST_PX else ()
    spots_at = {diameter: _spots(image, diameter, max(1, int(diameter / 6))) for diameter in scales}
    for diameter in sorted(spots_at, key=lambda one: _most_merit(spots_at[one], one), reverse=True):
        spots = spots_at[diameter]
        if _most_merit(spots, diameter) <= merit:
            break
        basis = lattice_basis(spots.xy_px)
        detected = None if basis is None else assemble(spots, basis, diameter)
        if detected is not None and _merit(detected) > merit:
            best, merit = detected, _merit(detected)
    return best


def _merit(lattice: Lattice) -> float:
    """Markers explained, times the matched filter's signal to noise (amplitude times width) at this scale."""
    return float(lattice.detected.sum()) * lattice.strength * lattice.diameter_px


def _most_merit(spots: Candidates, diameter: float) -> float:
    """The merit of no grid of these spots exceeds this: n of them have at most the median of the n strongest."""
    n = np.arange(1, len(spots.strength) + 1)
    return float((n * spots.strength[(n - 1) // 2].astype(np.float64)).max(initial=0.0)) * diameter


def _spots(image: NDArray[np.uint8], diameter: float, shrink: int) -> Candidates:
    """The strong spots of this scale, strongest first; none unless they lie about as far apart as such markers do."""
    spots = _strong(MarkerDetector(diameter, 2.6 * diameter, shrink).detect(image, 2.0))
    basis = lattice_basis(spots.xy_px)
    pitch = 0.0 if basis is None else float(np.linalg.norm(basis, axis=1).mean())
    if not 1.4 * diameter < pitch < 8 * diameter:
        return spots.only(np.zeros(0, np.intp))
    return _strong(MarkerDetector(diameter, pitch, shrink).detect(image, 2.0))


def _strong(spots: Candidates) -> Candidates:
    """Drop spots much weaker than a typical strong one (grain, texture), and bound their number."""
    if len(spots.strength) == 0:
        return spots
    level = float(np.percentile(spots.strength, 80))
    keep = np.flatnonzero(spots.strength > 0.35 * level)[:1500]
    return spots.only(keep)


def assemble(spots: Candidates, basis: FloatArray, diameter_px: float) -> Lattice | None:
    """The largest grid among the candidates, or None below 5 x 5 nodes or 60 % filled."""
    best: tuple[NDArray[np.intp], BoolArray] | None = None
    middle, near = np.median(spots.xy_px, axis=0), neighbours(spots.xy_px)
    for seed in np.argsort(np.square(spots.xy_px - middle).sum(1))[:40:8].tolist():
        index, reached = flood(spots.xy_px, near, basis, np.array([seed]), np.zeros((1, 2), np.intp))
        if best is None or reached.sum() > best[1].sum():
            best = (index, reached)
        if best[1].mean() > 0.7:
            break
    if best is None or best[1].sum() < 25:
        return None
    return _crop(spots, best[0], best[1], diameter_px)


def _crop(spots: Candidates, index: NDArray[np.intp], reached: BoolArray, diameter_px: float) -> Lattice | None:
    cells = index[reached] - index[reached].min(0)
    cols, rows = (cells.max(0) + 1).tolist()
    detected = np.zeros((rows, cols), np.bool_)
    detected[cells[:, 1], cells[:, 0]] = True
    xy = np.zeros((rows, cols, 2), np.float32)
    xy[cells[:, 1], cells[:, 0]] = spots.xy_px[reached]
    strength = np.zeros((rows, cols), np.float32)
    strength[cells[:, 1], cells[:, 0]] = spots.strength[reached]
    # Stray spots beyond the gel add sparse rows; a row counts only if a third of it is there.
    row_ok = _run(detected.mean(1) > 0.34)
    if not detected[row_ok].size:
        return None
    col_ok = _run(detected[row_ok].mean(0) > 0.34)
    detected, xy, strength = detected[row_ok, col_ok], xy[row_ok, col_ok], strength[row_ok, col_ok]
    if min(detected.shape) < 5 or detected.mean() < 0.6:
        return None
    filled, basis = fill_gaps(xy, detected)
    lattice = Lattice(filled, detected, basis, diameter_px, float(np.median(strength[detected])))
    return None if _strewn(lattice) else lattice


def _strewn(lattice: Lattice) -> bool:
    """Whether the spots lie like dots at random, about a straight grid and about one that is seen through a lens.

    Those of noise can be linked, too.
    """
    seen_through_a_lens = bent_print(*lattice.detected.shape)
    straight = seen_through_a_lens[..., :3]
    return min(_scatter_about(terms, lattice) for terms in (straight, seen_through_a_lens)) > _STREWN


def _scatter_about(terms: NDArray[np.float64], lattice: Lattice) -> float:
    """Mean `scatter` of the spots about the grid of these terms [rows, cols, m] that fits them best."""
    may = lattice.detected
    weights = np.linalg.lstsq(terms[may], lattice.xy_px[may].astype(np.float64), rcond=None)[0]
    off = (lattice.xy_px - terms @ weights).astype(np.float32)
    apart = scatter(off - neighbour_mean(off, may), lattice.pitch_px)[may]
    free_n = len(apart) - int(terms.shape[-1])  # the fewer spots, the more of any motion a fit explains
    return float(apart.sum()) / free_n


def _run(good: BoolArray) -> slice:
    """The longest run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], good.astype(np.int8), [0]])))
    if edges.size == 0:
        return slice(0, 0)
    starts, ends = edges[::2], edges[1::2]
    longest = int((ends - starts).argmax())
    return slice(int(starts[longest]), int(ends[longest]))


def fill_gaps(xy: FloatArray, detected: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Nodes not detected are placed on a cubic surface through the detected ones; also the mean basis [2, 2]."""
    rows, cols = detected.shape
    v, u = np.mgrid[0:rows, 0:cols].astype(np.float64)
    u, v = u / max(cols - 1, 1) - 0.5, v / max(rows - 1, 1) - 0.5  # powers of whole numbers are ill conditioned
    order = 3 if detected.sum() >= 40 else 1
    terms = np.stack([u**i * v**j for i in range(order + 1) for j in range(order + 1 - i)], -1)
    weights = np.linalg.lstsq(terms[detected], xy[detected].astype(np.float64), rcond=None)[0]
    smooth = (terms @ weights).astype(np.float32)
    filled = np.where(detected[..., None], xy, smooth)
    basis = np.stack([np.diff(smooth, axis=1).mean((0, 1)), np.diff(smooth, axis=0).mean((0, 1))])
    return filled, basis.astype(np.float32)
