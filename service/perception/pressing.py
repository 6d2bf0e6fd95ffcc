"""The gel's motion in physical terms: on a fixed lattice in mm, in steps of depth since the object first moved.

A frame's depth follows from its stamp and the arm's speed. Motion grows from the depth of first contact, which lies
between two frames; it is found by extrapolating the first growth backwards. Between frames the field is interpolated
linearly, so the mean over a step of depth is a weighted mean of frames: the same for every rate and speed.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from service.contract.model_card import Lattice, Pressing

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
VISIBLE_SHARE = 0.25  # share of the markers that could show a point's motion
CLOSEST_MM = 1e-4  # least distance of two moments
_LEAST_GROWTH = 1e-6


def lattice_weights(rest_mm: Floats, lattice: Lattice, pitch_mm: float) -> Floats:
    """Weights [rows * columns, n] of markers resting at ``rest_mm`` [n, 2] for the motion of each lattice point.

    A marker contributes to the points around it, less with distance. The range is the lattice's pitch or, if coarser,
    the markers' ``pitch_mm``. 1 is the sum of a point surrounded by markers.
    """
    reach = max(lattice.pitch_mm, pitch_mm)
    apart = np.abs(lattice.points_mm.reshape(-1, 1, 2) - rest_mm[None]) / reach
    near = np.clip(1.0 - apart, 0.0, None).prod(-1)
    return np.asarray(near * (pitch_mm / reach) ** 2, np.float32)


def on_lattice(moved_mm: Floats, visible: NDArray[np.bool_], weights: Floats) -> Floats:
    """Motion [n, 2] in mm of markers that are ``visible`` [n] -> [points, 3]: (du_mm, dv_mm, 1 or 0 if not visible)."""
    shared = weights * visible
    total = shared.sum(1, keepdims=True)
    mean = shared @ np.where(visible[:, None], moved_mm, 0.0) / np.maximum(total, _LEAST_GROWTH)
    enough = (total > VISIBLE_SHARE).astype(np.float32)
    return np.concatenate([mean * enough, enough], 1).astype(np.float32)


def onset_depth(depths_mm: Doubles, moved: Floats, first: int) -> float:
    """Depth at which motion began, if frame ``first`` is the first to show it and one more has followed.

    ``moved`` [n, ...] against rest. A frame's motion is measured along the next one's, where noise adds nothing; the
    line through both, extrapolated to zero, lies between the frame and the one before.
    """
    later = moved[first + 1].ravel().astype(np.float64)
    length = float(later @ later)
    share = float(moved[first].ravel() @ later) / max(length, _LEAST_GROWTH)
    gone_mm = depths_mm[first + 1] - depths_mm[first]
    back_mm = gone_mm * share / max(1.0 - share, _LEAST_GROWTH)
    earliest = depths_mm[first - 1] if first else depths_mm[first] - gone_mm
    return float(np.clip(depths_mm[first] - back_mm, earliest, depths_mm[first] - CLOSEST_MM))


def step_weights(depths_mm: Doubles, begin_mm: float, end_mm: float) -> Doubles:
    """Weights [n] of frames at rising depths for the mean between ``begin_mm`` and ``end_mm``."""
    inner = depths_mm[(depths_mm > begin_mm) & (depths_mm < end_mm)]
    places = np.concatenate([[begin_mm], inner, [end_mm]])
    upper = np.clip(np.searchsorted(depths_mm, places), 1, len(depths_mm) - 1)
    share = (places - depths_mm[upper - 1]) / (depths_mm[upper] - depths_mm[upper - 1])
    share = np.clip(share, 0.0, 1.0)  # nothing is known before the first frame
    widths = np.diff(places)
    trapezoid = 0.5 * (np.concatenate([[0.0], widths]) + np.concatenate([widths, [0.0]])) / (end_mm - begin_mm)
    weights = np.zeros(len(depths_mm))
    np.add.at(weights, upper - 1, trapezoid * (1.0 - share))
    np.add.at(weights, upper, trapezoid * share)
    return weights


@dataclass(slots=True)
class Legs:
    """The speeds at which an arm descends, each from a stamp on; a pause is a leg without speed."""

    _legs: list[tuple[int, float]] = field(default_factory=list)
    _pauses: list[tuple[int, int]] = field(default_factory=list)

    @property
    def paused_ns(self) -> int | None:
        """End of the last pause, None without one."""
        return self._pauses[-1][1] if self._pauses else None

    def add(self, from_ns: int, speed_mm_s: float) -> None:
        """From that stamp on the arm goes at that speed."""
        self._legs.append((from_ns, speed_mm_s))

    def pauses(self, until_ns: int, paused_s: float) -> None:
        """The arm stood for so long, and goes on at the speed it had."""
        going_mm_s, from_ns = self._legs[-1][1] if self._legs else 0.0, until_ns - round(paused_s * 1e9)
        self._legs += [(from_ns, 0.0), (until_ns, going_mm_s)]
        self._pauses.append((from_ns, until_ns))

    def going_ns(self, since_ns: int, until_ns: int) -> int:
        """The time between two stamps, without the pauses in it."""
        stood_ns = sum(max(0, min(end, until_ns) - max(begin, since_ns)) for begin, end in self._pauses)
        return until_ns - since_ns - stood_ns

    def speed_mm_s(self, at_ns: int) -> float | None:
        """The speed at a stamp, the first one before; None if none is known."""
        before = [speed for from_ns, speed in self._legs if from_ns <= at_ns]
        return before[-1] if before else self._legs[0][1] if self._legs else None

    def travel_mm(self, since_ns: int, until_ns: int) -> float:
        """The way between two stamps, mm, 0 while no speed is known; negative if the second comes first."""
        if until_ns < since_ns:
            return -self.travel_mm(until_ns, since_ns)
        if not self._legs:
            return 0.0
        way_mm, ends = 0.0, [*(from_ns for from_ns, _ in self._legs[1:]), until_ns]
        for k, ((from_ns, speed_mm_s), end_ns) in enumerate(zip(self._legs, ends, strict=True)):
            begin_ns = max(since_ns, from_ns) if k else since_ns
            way_mm += max(0, min(end_ns, until_ns) - begin_ns) * 1e-9 * speed_mm_s
        return way_mm


@dataclass(slots=True)
class DepthSteps:
    """One descent, fed frame by frame from a few before the onset on; returns each step of depth once complete."""

    spec: Pressing
    legs: Legs
    begin_mm: float | None = None
    steps_n: int = 0
    _start_ns: int = 0
    _first: int = 0
    _depths_mm: list[float] = field(default_factory=list)
    _fields: list[Floats] = field(default_factory=list)
    _rest: Floats | None = None

    @property
    def pressed_mm(self) -> float:
        """Travel of the press since its onset, 0 while unknown."""
        return 0.0 if self.begin_mm is None else self._depths_mm[-1] - self.begin_mm

    def pressed_at_mm(self, stamp_ns: int) -> float | None:
        """Travel of the press since its onset at that stamp, None while the onset is unknown."""
        return None if self.begin_mm is None else self._depth_mm(stamp_ns) - self.begin_mm

    def _depth_mm(self, stamp_ns: int) -> float:
        return self.legs.travel_mm(self._start_ns, stamp_ns)

    def begin(self, stamps_ns: list[int], fields: list[Floats], first: int) -> None:
        """Take the frames so far, fields [2, rows, columns, 3] each; ``first`` is the first to show motion.

        Frames before it are at rest; the frame just before may have begun to move.
        """
        before = fields[: max(1, first - 1)]
        self._rest = np.mean(before, 0, dtype=np.float32)
        self._rest[..., 2] = np.min([one[..., 2] for one in before], 0)
        kept = max(0, first - 1)
        self._start_ns, self._first = stamps_ns[kept], first - kept
        for stamp_ns, one in zip(stamps_ns[kept:], fields[kept:], strict=True):
            self.add(stamp_ns, one)

    def add(self, stamp_ns: int, field_mm: Floats) -> None:
        """Take the next frame; one no later than the last is dropped."""
        depth_mm = self._depth_mm(stamp_ns)
        if self._depths_mm and depth_mm < self._depths_mm[-1] + CLOSEST_MM:
            return
        self._depths_mm.append(depth_mm)
        self._fields.append(self._moved(field_mm))
        if self.begin_mm is None and len(self._fields) > self._first + 1:
            self._find_onset()

    def fresh(self) -> list[Floats]:
        """The steps [2, rows, columns, 3] completed since the last call, at most ``spec.steps_n`` in all."""
        steps: list[Floats] = []
        depths_mm, size_mm = np.array(self._depths_mm), self.spec.step_mm
        while self.begin_mm is not None and self.steps_n < self.spec.steps_n:
            end_mm = self.begin_mm + (self.steps_n + 1) * size_mm
            if depths_mm[-1] < end_mm:
                break
            steps.append(self._mean(step_weights(depths_mm, end_mm - size_mm, end_mm)))
            self.steps_n += 1
        return steps

    def _mean(self, weights: Doubles) -> Floats:
        used = np.flatnonzero(weights)
        stack = np.stack([self._fields[k] for k in used])
        visible = stack[..., 2:].min(0)
        moved = np.tensordot(weights[used], stack[..., :2], 1) * visible
        return np.concatenate([moved, visible], -1).astype(np.float32)

    def _moved(self, field_mm: Floats) -> Floats:
        assert self._rest is not None
        visible = np.minimum(field_mm[..., 2:], self._rest[..., 2:])
        return np.concatenate([(field_mm[..., :2] - self._rest[..., :2]) * visible, visible], -1)

    def _find_onset(self) -> None:
        """Put a field at rest at the onset, in place of the frames before it."""
        first, moved = self._first, np.stack(self._fields)[..., :2]
        self.begin_mm = onset_depth(np.array(self._depths_mm), moved, first)
        still = np.zeros_like(self._fields[0])
        still[..., 2] = self._fields[first][..., 2]
        self._depths_mm[:first], self._fields[:first] = [self.begin_mm], [still]
