"""A regular grid seen through a lens: found in one raw frame in spite of debris, flares, missing and merged dots.

Spots linked by topology give a first homography. The frame is then rectified, so all markers have one size and
distance, searched again, and matched to the predicted nodes, round by round with a narrower gate. Outliers are no
markers. Radial terms are included while they lower Schwarz's criterion (BIC, 1978).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from service.contract import Sensor
from service.perception.lens import Float64, Lens, Projection, Warp, transformed
from service.perception.markers.detect import Candidates, MarkerDetector
from service.perception.markers.field import BoolArray
from service.perception.markers.lattice import Lattice, find_lattice

Image = NDArray[np.uint8]
_GATES = (0.3, 0.2, 0.15, 0.12)  # pitch; largest distance of a spot from its node, round by round
_BEYOND = 3  # steps beyond the known grid in which more markers are sought
_WEAK, _ROUND = 0.25, 0.45  # of the typical marker's strength and tightness
_ALIKE = 0.7  # of a marker's strength and tightness
_FAR = 2.7  # medians; a marker further off its node (3.2 sigma) is displaced, damaged or false
_MESH_PX = 4
_SPARE = 1.25
_ROW_SHARE = 0.34  # share of a row or column that must be present
_ROUGH = (2,)
_TERMS = (0, 1, 2, 4)  # radial parameters tried: none, k1, k1 k2, k1 k2 and the centre
_ORDER, _SAMPLES, _PAYS = 6, 3, 0.97  # of the warp: highest order, markers per term, required gain of the next order
_PITCH_PX = (10.0, 40.0)  # of the frame that is searched


@dataclass(frozen=True, slots=True)
class GridFit:
    """The markers: their grid cells int [n, 2] (column, row, from 0), raw px [n, 2], and the fitted model.

    ``shape`` is (rows, columns), ``pitch_px`` the mean distance in the raw frame, ``diameter_px`` likewise.
    ``displaced_n`` visible markers lie off their nodes.
    """

    cells: NDArray[np.intp]
    raw_px: Float64
    projection: Projection
    shape: tuple[int, int]
    pitch_px: float
    diameter_px: float
    displaced_n: int

    @property
    def present(self) -> BoolArray:
        """Which nodes [rows, columns] have a marker in the correct place."""
        there = np.zeros(self.shape, np.bool_)
        there[self.cells[:, 1], self.cells[:, 0]] = True
        return there

    @property
    def off(self) -> Float64:
        """Distance of each marker from its node, in grid units [n, 2]."""
        return self.projection.plane(self.raw_px) - self.cells


def fit_grid(image: Image, sensor: Sensor | None = None) -> GridFit | None:
    """The grid of a raw frame uint8 [h, w, 3], or None; at most the rows and columns of ``sensor``, if given."""
    best: GridFit | None = None
    for picture in _pictures(image):
        start = find_lattice(picture)
        fit = None if start is None else _refined(picture, start, sensor)
        if fit is not None and (best is None or len(fit.cells) > len(best.cells)):
            best = fit
        if best is not None and best.present.mean() > 0.85:
            break
    return best


def _pictures(image: Image) -> Iterator[Image]:
    """Grey, and each colour: under coloured light a gel may show its markers in only one of them."""
    if image.ndim == 2:
        yield image
        return
    yield np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
    for channel in (1, 2, 0):
        yield np.ascontiguousarray(image[..., channel])


def _refined(image: Image, start: Lattice, sensor: Sensor | None) -> GridFit | None:
    rows, columns = np.nonzero(start.detected)
    cells, raw = np.stack([columns, rows], 1), start.xy_px[start.detected].astype(np.float64)
    size = (image.shape[1], image.shape[0])
    model, _, _ = _settled(raw, cells, size, _ROUGH)
    diameter = start.diameter_px / start.pitch_px  # in pitches
    for last, gate in zip((False, False, False, True), _GATES, strict=True):
        if model is None:
            return None
        spots, centres = _search(image, model, cells, start.pitch_px, diameter)
        cells, raw = _matched(spots, centres, model, gate, size)
        cells, raw = _kept(cells, raw, sensor)
        if len(cells) < 25:
            return None
        model, cells, raw = _settled(raw, cells, size, _TERMS if last else _ROUGH)
    if model is None:
        return None
    low, shape = cells.min(0), cells.max(0) - cells.min(0) + 1
    displaced = _displaced(*_search(image, model, cells, start.pitch_px, diameter), cells)
    projection = model.scaled(1.0, -low.astype(np.float64))
    rows_columns = (int(shape[1]), int(shape[0]))
    return GridFit(cells - low, raw, projection, rows_columns, start.pitch_px, start.diameter_px, displaced)


def _displaced(spots: Candidates, centres: Float64, cells: NDArray[np.intp]) -> int:
    """Number of spots that look like markers and belong to a node of the grid, but lie off it."""
    nodes = np.round(centres).astype(np.intp)
    known = {tuple(cell) for cell in cells.tolist()}
    inside = ((nodes >= cells.min(0)) & (nodes <= cells.max(0))).all(1)
    mine = np.array([tuple(node) in known for node in nodes.tolist()])
    if not (inside & mine).any():
        return 0
    typical, tight = np.median(spots.strength[inside & mine]), np.median(spots.tightness[inside & mine])
    alike = (spots.strength > _ALIKE * typical) & (spots.tightness > _ALIKE * tight) & inside & ~mine
    return len({tuple(node) for node in nodes[alike].tolist()})


def _search(
    image: Image, model: Projection, cells: NDArray[np.intp], pitch_px: float, diameter: float
) -> tuple[Candidates, Float64]:
    """Spots of the rectified frame, and their grid coordinates [n, 2]."""
    pitch = float(np.clip(pitch_px, *_PITCH_PX))
    low, high = cells.min(0) - _BEYOND, cells.max(0) + _BEYOND
    coarse = (np.ceil((high - low) * pitch / _MESH_PX)).astype(int) + 1
    grid = np.stack(np.meshgrid(*(np.arange(n) for n in coarse)), -1) * _MESH_PX / pitch + low
    source = np.clip(model.raw(grid.reshape(-1, 2)), -1e4, 1e4).astype(np.float32).reshape(grid.shape)
    # The map is smooth: between the nodes of a mesh of 4 px it is linear to a thousandth of a pixel.
    finer = np.array([[1, 0, 0], [0, 1, 0]]) / _MESH_PX
    size = ((coarse - 1) * _MESH_PX + 1).tolist()
    source = cv2.warpAffine(source, finer, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    flat = cv2.remap(image, source[..., 0], source[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    spots = MarkerDetector(diameter * pitch, pitch).detect(np.asarray(flat, np.uint8), 2.0)
    return spots, spots.xy_px.astype(np.float64) / pitch + low


def _matched(
    spots: Candidates, centres: Float64, model: Projection, gate: float, size: tuple[int, int]
) -> tuple[NDArray[np.intp], Float64]:
    """Cells [n, 2] and raw px [n, 2] of the spots that are markers: near a node, strong and round enough, in view."""
    nodes = np.round(centres).astype(np.intp)
    off = np.linalg.norm(centres - nodes, axis=1)
    raw = model.raw(centres)
    inside = (raw > 1).all(1) & (raw < np.array(size) - 2).all(1)
    good = inside & (off < gate)
    if not good.any():
        return nodes[:0], raw[:0]
    typical, tight = np.median(spots.strength[good]), np.median(spots.tightness[good])
    good &= (spots.strength > _WEAK * typical) & (spots.tightness > _ROUND * tight)
    order = np.flatnonzero(good)
    order = order[np.argsort(off[order])]
    _, first = np.unique(nodes[order], axis=0, return_index=True)
    chosen = order[first]
    return nodes[chosen], raw[chosen]


def _kept(cells: NDArray[np.intp], raw: Float64, sensor: Sensor | None) -> tuple[NDArray[np.intp], Float64]:
    """Remove stray rows and columns at the borders; keep at most the sensor's number, where most markers are."""
    most = (256, 256) if sensor is None else (sensor.marker_columns, sensor.marker_rows)
    for _ in range(2):
        for axis in (0, 1):
            if not len(cells):
                return cells, raw
            low = int(cells[:, axis].min())
            counts = np.bincount(cells[:, axis] - low)
            begin, end = _window(counts, most[axis])
            keep = (cells[:, axis] >= low + begin) & (cells[:, axis] < low + end)
            cells, raw = cells[keep], raw[keep]
    return cells, raw


def _window(counts: NDArray[np.intp], most: int) -> tuple[int, int]:
    """The stretch of present rows, [begin, end), at most ``most`` long, with the most markers.

    If there are more than a view beyond the usual edge could add, it is another sensor, and left whole.
    """
    there = counts >= _ROW_SHARE * np.percentile(counts[counts > 0], 80)
    middle = int(np.argmax(np.convolve(counts, np.ones(5), "same")))
    begin = end = middle
    while begin > 0 and there[begin - 1]:
        begin -= 1
    while end < len(counts) and (there[end] or end == middle):
        end += 1
    if most < end - begin <= _SPARE * most:
        sums = np.convolve(counts[begin:end], np.ones(most), "valid")
        begin += int(np.argmax(sums))
        end = begin + most
    return begin, end


def _settled(
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
        model = fit_model(raw, cells, size, count)
        if model is None:
            continue
        squares = float(np.square(model.plane(raw) - cells).sum())
        n = 2 * len(raw)
        score = n * np.log(squares / n + 1e-12) + (8 + count) * np.log(n)
        if score < least:
            best, least = model, score
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


def fit_model(raw: Float64, cells: NDArray[np.intp], size: tuple[int, int], terms: int) -> Projection | None:
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
