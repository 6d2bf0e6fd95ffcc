"""A regular grid seen through a lens: found in one raw frame in spite of debris, flares, missing and merged dots.

Spots linked by topology give a first homography. The frame is then rectified, so all markers have one size and
distance, searched again, and matched to the predicted nodes, round by round with a narrower gate. Outliers are no
markers. Radial terms are included while they lower Schwarz's criterion (BIC, 1978).
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from service.contract import Sensor
from service.contract.sensor import EDGES, Edge
from service.perception.lens import Float64, Projection, scale_of, transformed
from service.perception.markers.detect import Candidates, MarkerDetector
from service.perception.markers.field import BoolArray
from service.perception.markers.lattice import Lattice, find_lattice
from service.tools.lens_fit import settled

Image = NDArray[np.uint8]
# round by round: largest distance of a spot from its node, in pitches, and share of a row that must be present; within
# a wide gate a few false spots lie near the nodes of any row
_ROUNDS = ((0.3, 0.34), (0.2, 0.34), (0.15, 0.2), (0.12, 0.2))
_BEYOND = 4  # steps beyond the known grid in which more markers are sought
_WEAK, _ROUND = 0.25, 0.45  # of the typical marker's strength and tightness
_ALIKE = 0.7  # of a marker's strength and tightness
_MESH_PX = 4
_SPARE = 1.25
_LARGEST_PX = 640
_GAP = 2  # rows that may be hidden between others
_ELSEWHERE = 1.0  # pitches from any possible place: the profile's view is not that of this camera
_ROUGH = (2,)
_TERMS = (0, 1, 2, 4)  # radial parameters tried: none, k1, k1 k2, k1 k2 and the centre
_PITCH_PX = (10.0, 40.0)  # of the frame that is searched


@dataclass(frozen=True, slots=True)
class GridFit:
    """The markers: their grid cells int [n, 2] (column, row, from 0), raw px [n, 2], and the fitted model.

    ``shape`` is (rows, columns), ``pitch_px`` the mean distance in the raw frame, ``diameter_px`` likewise.
    ``displaced_n`` visible markers lie off their nodes. ``in_view`` is the shape before rows or columns beyond the
    sensor's number were left out.
    """

    cells: NDArray[np.intp]
    raw_px: Float64
    projection: Projection
    shape: tuple[int, int]
    pitch_px: float
    diameter_px: float
    displaced_n: int
    in_view: tuple[int, int]

    @property
    def present(self) -> BoolArray:
        """Which nodes [rows, columns] have a marker in the correct place."""
        there = np.zeros(self.shape, np.bool_)
        there[self.cells[:, 1], self.cells[:, 0]] = True
        return there

    @property
    def slant_deg(self) -> float:
        """How far columns and rows are from a right angle in the middle of the raw frame."""
        middle = (np.array(self.shape[::-1]) - 1) / 2
        start, *ends = self.projection.raw(middle + np.array([(0, 0), (1, 0), (0, 1)]))
        along, across = ((end - start) / np.linalg.norm(end - start) for end in ends)
        return float(np.degrees(np.arcsin(abs(along @ across))))

    @property
    def off(self) -> Float64:
        """Distance of each marker from its node, in grid units [n, 2]."""
        return self.projection.plane(self.raw_px) - self.cells

    def moved(self, change: Float64) -> "GridFit":
        """The grid in a raw frame to which the similarity ``change`` [3, 3] takes the points of this one's."""
        scale = scale_of(change)
        return replace(
            self,
            raw_px=transformed(change, self.raw_px),
            projection=self.projection.moved(change),
            pitch_px=self.pitch_px * scale,
            diameter_px=self.diameter_px * scale,
        )


class _Expected(NamedTuple):
    """The most columns and rows [2] that are kept, and where their middle may lie in the frame, px [2, 2].

    The first place is the profile's, the second the middle of the picture.
    """

    counts: NDArray[np.intp]
    middles_px: Float64

    @classmethod
    def of(cls, sensor: Sensor, image: Image, change: Float64) -> "_Expected":
        """Those of a sensor, in a frame whose points ``change`` [3, 3] takes to the raw frame ``image``."""
        raw_size = np.array([sensor.raw_width_px, sensor.raw_height_px])
        nominal = transformed(view_of(sensor), sensor.marker_rest_px().mean((0, 1))[None])
        middles = (np.concatenate([nominal, (raw_size[None] - 1) / 2]) + 0.5) * image.shape[1::-1] / raw_size - 0.5
        there = transformed(np.asarray(np.linalg.inv(change)), middles)
        return cls(np.array([sensor.marker_columns, sensor.marker_rows]), there)


def view_of(sensor: Sensor) -> Float64:
    """The profile's nominal homography [3, 3], from the rectified to the raw frame, both in px."""
    width, height = sensor.width_px - 1, sensor.height_px - 1
    corners = np.array([(0, 0), (width, 0), (width, height), (0, height)], np.float32)
    return np.asarray(cv2.getPerspectiveTransform(corners, np.asarray(sensor.corners_raw_px, np.float32)), np.float64)


def fit_grid(image: Image, sensor: Sensor | None = None, up: Edge = "top") -> GridFit | None:
    """The grid of a raw frame uint8 [h, w, 3], or None; at most the rows and columns of ``sensor``, if given.

    Of more rows or columns those are kept that lie nearest to where the profile has them. The first row is that at the
    edge ``up``. A large frame is searched in a smaller copy, since the filters are made for markers of up to 25 px.
    """
    turns, factor = EDGES.index(up), -(-max(image.shape[:2]) // _LARGEST_PX)
    change = _turned(turns, image.shape[1], image.shape[0])
    searched = np.ascontiguousarray(np.rot90(image, turns))
    if factor > 1:
        whole = searched[: searched.shape[0] // factor * factor, : searched.shape[1] // factor * factor]
        size = (whole.shape[1] // factor, whole.shape[0] // factor)
        searched = np.asarray(cv2.resize(whole, size, interpolation=cv2.INTER_AREA), np.uint8)
        shift = (factor - 1) / 2  # pixel centres lie at integers
        change = change @ np.array([[factor, 0, shift], [0, factor, shift], [0, 0, 1.0]])
    expected = None if sensor is None else _Expected.of(sensor, image, change)
    best: GridFit | None = None
    for picture in _pictures(searched):
        start = find_lattice(picture)
        fit = None if start is None else _refined(picture, start, expected)
        if fit is not None and (best is None or len(fit.cells) > len(best.cells)):
            best = fit
        if best is not None and best.present.mean() > 0.85:
            break
    return None if best is None else best.moved(change)


def _turned(turns: int, width_px: int, height_px: int) -> Float64:
    """From the points of a frame after ``turns`` quarter turns to the left to those before, [3, 3]."""
    change = np.eye(3)
    for k in range(turns):
        width = (width_px, height_px)[k % 2]
        change = change @ np.array([[0, -1, width - 1], [1, 0, 0], [0, 0, 1.0]])
    return change


def _pictures(image: Image) -> Iterator[Image]:
    """Grey, and each colour: under coloured light a gel may show its markers in only one of them."""
    if image.ndim == 2:
        yield image
        return
    yield np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
    for channel in (1, 2, 0):
        yield np.ascontiguousarray(image[..., channel])


def _refined(image: Image, start: Lattice, expected: _Expected | None) -> GridFit | None:
    rows, columns = np.nonzero(start.detected)
    cells, raw = np.stack([columns, rows], 1), start.xy_px[start.detected].astype(np.float64)
    size = (image.shape[1], image.shape[0])
    model, _, _ = settled(raw, cells, size, _ROUGH)
    diameter, in_view = start.diameter_px / start.pitch_px, (0, 0)  # in pitches; rows and columns
    for k, (gate, share) in enumerate(_ROUNDS, 1):
        last = k == len(_ROUNDS)
        if model is None:
            return None
        spots, centres = _search(image, model, cells, start.pitch_px, diameter)
        cells, raw = _matched(spots, centres, model, gate, size)
        cells, raw, in_view = _kept(cells, raw, share, expected if last else None, model)
        if len(cells) < 25:
            return None
        model, cells, raw = settled(raw, cells, size, _TERMS if last else _ROUGH)
    if model is None:
        return None
    low, shape = cells.min(0), cells.max(0) - cells.min(0) + 1
    spots, centres = _search(image, model, cells, start.pitch_px, diameter)
    between, _ = _search(np.asarray(255 - image, np.uint8), model, cells, start.pitch_px, diameter)
    if len(between.strength) and np.median(between.strength[: len(cells)]) > np.median(spots.strength[: len(cells)]):
        return None  # the gaps of a grid of light markers: these cover less of the gel, and so stand out further
    displaced = _displaced(spots, centres, cells)
    projection = model.scaled(1.0, -low.astype(np.float64))
    rows_columns = (int(shape[1]), int(shape[0]))
    return GridFit(cells - low, raw, projection, rows_columns, start.pitch_px, start.diameter_px, displaced, in_view)


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


def _kept(
    cells: NDArray[np.intp], raw: Float64, share: float, expected: _Expected | None, model: Projection
) -> tuple[NDArray[np.intp], Float64, tuple[int, int]]:
    """Remove stray rows and columns at the borders, and keep at most the sensor's number.

    Also how many rows and columns there were, before some of them were left out.
    """
    middles = np.zeros((0, 2)) if expected is None else model.plane(expected.middles_px)
    longest = [0, 0]
    for _ in range(2):
        for axis in (0, 1):
            if not len(cells):
                return cells, raw, (0, 0)
            low = int(cells[:, axis].min())
            counts = np.bincount(cells[:, axis] - low)
            begin, end = _run(counts, share)
            longest[axis] = max(longest[axis], end - begin)
            if expected is not None:
                begin, end = _window(begin, end, int(expected.counts[axis]), middles[:, axis] - low)
            keep = (cells[:, axis] >= low + begin) & (cells[:, axis] < low + end)
            cells, raw = cells[keep], raw[keep]
    return cells, raw, (longest[1], longest[0])


def _run(counts: NDArray[np.intp], share: float) -> tuple[int, int]:
    """The stretch of present rows, [begin, end); up to two between others may be hidden."""
    there = np.flatnonzero(counts >= share * np.percentile(counts[counts > 0], 80))
    middle = int(np.argmax(np.convolve(counts, np.ones(5), "same")))
    stretches = np.split(there, np.flatnonzero(np.diff(there) > _GAP + 1) + 1)
    nearest = min(stretches, key=lambda rows: int(np.abs(rows - middle).min()))
    return int(nearest[0]), int(nearest[-1]) + 1


def _window(begin: int, end: int, most: int, middles: Float64) -> tuple[int, int]:
    """At most ``most`` of these rows, those nearest to the first of ``middles`` that can be theirs, else to the last.

    If there are more than a view beyond the usual edge could add, it is another sensor, and left whole.
    """
    if most < end - begin <= _SPARE * most:
        possible = np.arange(begin, end - most + 1) + (most - 1) / 2
        for middle in middles:
            off = np.abs(possible - middle)
            if off.min() <= _ELSEWHERE:
                break
        begin += int(np.argmin(off))
        end = begin + most
    return begin, end
