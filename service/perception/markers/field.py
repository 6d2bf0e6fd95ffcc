"""The marker field: motion of one finger's markers, indexed by their grid, from an image or from the simulator."""

from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from service.contract import MarkerSpec, Sensor

TrackStatus = Literal["tracking", "partial", "ambiguous", "lost", "duplicate", "no_grid"]
FloatArray = NDArray[np.float32]
BoolArray = NDArray[np.bool_]


MOST_SCATTER = 25.0
_FINGERPRINT = 0.03  # pitch; scatter of a correct match about its neighbours
_CARRIED = 2  # steps; a grid further outside its lattice belongs to another camera
_TOUCHED_N_PER_MM2 = 1e-4  # a simulated node that is pressed harder is in contact
_OTHER_PITCH = 0.15  # a grid whose pitch is this much off is another sensor's, not one with markers missing


@dataclass(frozen=True, slots=True)
class MarkerField:
    """Displacement of every marker of one finger at one instant, in pixels of the rectified image.

    ``rest_px`` float32 [rows, cols, 2] (u right, v down) is the marker's place in the tracker's first frame,
    ``displacement_px`` float32 [rows, cols, 2] its motion since. Both are finite everywhere: where ``valid`` [rows,
    cols] is False the displacement is interpolated from the neighbours and is no evidence. ``contact`` [rows, cols]
    marks the nodes that touch the object, None if unknown. ``status`` "no_grid" comes with empty arrays, "ambiguous"
    follows a jump that may be one of a whole pitch. ``captured_ns`` is the frame's monotonic stamp.
    """

    rest_px: FloatArray
    displacement_px: FloatArray
    valid: BoolArray
    contact: BoolArray | None
    pitch_px: float
    captured_ns: int
    status: TrackStatus = "tracking"
    reason: str = ""

    @property
    def usable(self) -> bool:
        """True if the field carries new evidence: tracked, and not a repetition of the frame before."""
        return self.status in {"tracking", "partial"}


def marker_array(field: MarkerField, lattice: MarkerSpec) -> FloatArray:
    """Float32 [rows, columns, 3] on a sensor's lattice: (du_px, dv_px, 1) of each marker, zeros where it is not valid.

    This is the networks' input. A tracker that found fewer rows or columns, for example at dark edges, fills its part:
    the grid is placed where most of its nodes rest, since a firm grasp bulges the gel by more than half a pitch before
    the tracker first sees it. Raises ValueError on a grid that is empty, of another pitch, or elsewhere.
    """
    rows, columns = field.valid.shape
    if not rows or abs(field.pitch_px / lattice.pitch_px - 1) > _OTHER_PITCH:
        raise ValueError(
            f"a grid of {rows} x {columns} markers {field.pitch_px:.1f} px apart was found,"
            f" expected {lattice.rows} x {lattice.columns} at {lattice.pitch_px:g} px"
        )
    away = (field.rest_px - np.array(lattice.first_px, np.float32)) / lattice.pitch_px
    row, column = np.mgrid[0:rows, 0:columns]
    column = column + _laid(float(np.median(away[..., 0] - column)), lattice.columns - columns)
    row = row + _laid(float(np.median(away[..., 1] - row)), lattice.rows - rows)
    inside = field.valid & (row >= 0) & (row < lattice.rows) & (column >= 0) & (column < lattice.columns)
    if 2 * np.count_nonzero(inside) < np.count_nonzero(field.valid):
        raise ValueError("most markers found lie outside the lattice of the rectified frame: calibrate the camera")
    out = np.zeros((lattice.rows, lattice.columns, 3), np.float32)
    out[row[inside], column[inside], :2] = field.displacement_px[inside]
    out[row[inside], column[inside], 2] = 1.0
    return out


def _laid(away: float, room: int) -> int:
    """Whole steps by which to shift a grid that rests ``away`` pitches off its lattice, with ``room`` to move.

    A grid that fits must lie inside, even if its object had carried it by a pitch when the tracker began.
    """
    near = round(away)
    inside = min(max(near, 0), room)
    return inside if room >= 0 and abs(inside - near) <= _CARRIED else near


def empty_field(captured_ns: int, status: TrackStatus, reason: str) -> MarkerField:
    """A field without a grid: no marker was ever found."""
    nothing = np.zeros((0, 0, 2), np.float32)
    return MarkerField(nothing, nothing, np.zeros((0, 0), np.bool_), None, 1.0, captured_ns, status, reason)


def field_from_gel(gel: NDArray[np.floating], captured_ns: int, sensor: Sensor) -> MarkerField:
    """The true field of a simulated gel, so that slip and onset run without an image.

    ``gel`` [rows, cols, 3] is (du_mm, dv_mm, pressure_n_per_mm2) at the markers' rest positions in the finger frame.
    Pressed nodes are in contact. Raises ValueError if the shape is not the sensor's; non-finite nodes come out invalid
    with zero displacement.
    """
    expected = (sensor.marker_rows, sensor.marker_columns, 3)
    if gel.shape != expected:
        raise ValueError(f"gel is {list(gel.shape)}, expected {list(expected)}")
    state = np.asarray(gel, np.float32)
    valid: BoolArray = np.asarray(np.isfinite(state).all(-1))
    displacement = np.where(valid[..., None], state[..., :2], 0.0) * np.float32(
        sensor.marker_pitch_px / sensor.marker_pitch_mm
    )
    contact: BoolArray = valid & (state[..., 2] > _TOUCHED_N_PER_MM2)
    rest_px, pitch_px = sensor.marker_rest_px(), sensor.marker_pitch_px
    return MarkerField(rest_px, displacement.astype(np.float32), valid, contact, pitch_px, captured_ns)


def median(values: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    """Median of finite values [n, ...] along the first axis: equal to numpy's, at a quarter of its cost."""
    half = len(values) // 2
    if len(values) % 2:
        return np.asarray(np.partition(values, half, axis=0)[half])
    middle = np.partition(values, (half - 1, half), axis=0)
    return np.asarray((middle[half - 1] + middle[half]) / 2)


def neighbour_mean(values: FloatArray, valid: BoolArray) -> FloatArray:
    """Mean over the up to eight valid neighbours of each node, 0 where it has none; ``values`` [rows, cols, 2]."""
    weight = valid.astype(np.float32)
    stack = np.dstack([values * weight[..., None], weight])
    around = cv2.boxFilter(stack, cv2.CV_32F, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT) - stack
    count = np.rint(around[..., 2:])
    return np.asarray(np.where(count > 0, around[..., :2] / np.maximum(count, 1), 0), np.float32)


def scatter(apart_px: FloatArray, pitch_px: float) -> FloatArray:
    """Squared deviation [rows, cols] of nodes from their neighbours' mean, in that of a correct match; at most 25.

    ``apart_px`` [rows, cols, 2] or of any nodes. Dots at random have a mean of some 20.
    """
    squared = apart_px[..., 0] * apart_px[..., 0] + apart_px[..., 1] * apart_px[..., 1]
    return np.minimum(squared / (_FINGERPRINT * pitch_px) ** 2, MOST_SCATTER)


def neighbour_median(values: FloatArray, valid: BoolArray) -> tuple[FloatArray, NDArray[np.intp]]:
    """Median over the up to eight valid neighbours of each node, and their number.

    ``values`` [rows, cols, 2] and ``valid`` [rows, cols]; the median is 0 where a node has no valid neighbour.
    """
    rows, cols = valid.shape
    padded = np.full((rows + 2, cols + 2, 2), np.inf, np.float32)
    padded[1:-1, 1:-1] = np.where(valid[..., None], values, np.float32(np.inf))
    around = [padded[i : i + rows, j : j + cols] for i in range(3) for j in range(3) if (i, j) != (1, 1)]
    stack = np.sort(np.stack(around), axis=0)
    count = np.isfinite(stack[..., 0]).sum(0)
    low, high = (count - 1) // 2, count // 2
    at = (np.arange(rows)[:, None], np.arange(cols)[None])
    median = (stack[low, at[0], at[1]] + stack[high, at[0], at[1]]) / 2
    return np.where(count[..., None] > 0, median, np.float32(0)).astype(np.float32), count
