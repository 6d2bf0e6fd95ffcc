"""The marker tracker: rectified frames in, a grid-indexed marker field out."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from service.perception.markers.detect import Candidates, MarkerDetector
from service.perception.markers.field import BoolArray, FloatArray, MarkerField, TrackStatus, empty_field, median
from service.perception.markers.lattice import Lattice, find_lattice
from service.perception.markers.matching import Match, View, match, reindex

_AROUND = [np.array([col, row], np.float32) for col in (-1, 0, 1) for row in (-1, 0, 1) if col or row]
_JUMP = 0.35  # pitch between two frames from which the true motion could be a whole pitch less, backwards
_STILL = 0.1  # pitch between two frames, below which the grid stands still
_AS_WELL = 15.0  # misfit of a row or column of nodes; one without spots, at the border, costs more than twice that
_LEAP = 0.5  # pitch between two frames, beyond which the match must be as good as usual
_DOUBTFUL = 5.0  # misfit per node above the running level
_SAME_GREY = (
    0.005  # mean distance below which a frame repeats the one before; of still real gels few come nearer than 0.02
)
_EVENER = 0.5  # of another placement's unevenness: that of the print as it was, not of one whole steps off
_CALM = 1.2  # misfit per node above the running level at which the grid is matched again by topology
_WHOLE = 0.8  # diameter; a marker nearer to the image's border than this is cut
_NEARER = 0.1  # diameter; and was carried there if its rest place is further inside by more than this
_RANDOM = 16.0  # mean scatter of noise and strewn dots: 22 and more; of 71,794 real frames: 15.0 at most
_SPARE = 1 / 3  # share of the shortest row; missing or surplus markers in a correct placement
_ROUND = 0.6  # share of the typical tightness; a marker smeared or stretched beyond this has no position
_SETTLED = 0.6  # above that level, placements further away are tried


@dataclass(frozen=True, slots=True)
class TrackerSettings:
    """The tracker's requirements of a frame.

    ``threshold`` is the weakest spot, as a share of the typical marker's strength; below ``lost_share`` of the markers
    in sight the grid is lost, below ``partial_share`` the field is marked as partial.
    """

    threshold: float = 0.3
    lost_share: float = 0.2
    partial_share: float = 0.6


class MarkerTracker:
    """Follows the markers of one finger; finds the grid's size, pitch and place in the first frame that shows one.

    No frame content raises: a black, white, covered or missing frame gives a field with status "lost" or "no_grid", a
    repeated frame or late stamp "duplicate"; a repeated frame that was lost is lost again. A frame that is no uint8
    image or changes size raises ValueError.
    """

    def __init__(self) -> None:
        self.settings = TrackerSettings()
        self._lattice: Lattice | None = None
        self._detector: MarkerDetector | None = None
        self._shape: tuple[int, ...] | None = None
        self._xy = np.zeros((0, 0, 2), np.float32)
        self._velocity = np.zeros((0, 0, 2), np.float32)  # px per second
        self._strength = 0.0
        self._level = 1.0
        self._last_ns: int | None = None
        self._last_image: NDArray[np.uint8] | None = None
        self._last_field: MarkerField | None = None
        self._why_lost = ""  # of the last image; "" if it was not

    def update(self, image: NDArray[np.uint8] | None, captured_ns: int) -> MarkerField:
        """Track one rectified frame, uint8 [height, width, 3] BGR or [height, width]; None stands for a missing one."""
        if image is None:
            return self._lost(captured_ns, "no frame from this finger")
        self._check(image)
        if self._last_ns is not None and captured_ns <= self._last_ns:
            return self._repeat(captured_ns, f"stamp {captured_ns} is not after {self._last_ns}")
        if self._last_image is not None and _repeats(image[::7], self._last_image[::7]):
            if self._why_lost:
                return self._lost(captured_ns, self._why_lost)
            return self._repeat(captured_ns, "the frame repeats the one before")
        self._last_image = image
        if self._lattice is None and not self._start(image):
            return empty_field(captured_ns, "no_grid", "no marker grid of at least 5 x 5 nodes in the frame")
        field = self._track(image, captured_ns)
        self._why_lost = field.reason if field.status == "lost" else ""
        return field

    def _check(self, image: NDArray[np.uint8]) -> None:
        if image.dtype != np.uint8 or image.ndim not in {2, 3} or (image.ndim == 3 and image.shape[2] != 3):
            raise ValueError(f"frame is {image.dtype}{list(image.shape)}, expected uint8 [height, width, 3]")
        if self._shape is not None and image.shape != self._shape:
            raise ValueError(f"frame is {list(image.shape)}, the tracker began with {list(self._shape)}")

    def _start(self, image: NDArray[np.uint8]) -> bool:
        lattice = find_lattice(image)
        if lattice is None:
            return False
        self._lattice = lattice
        self._detector = MarkerDetector(lattice.diameter_px, lattice.pitch_px, max(1, int(lattice.diameter_px / 6)))
        self._shape = image.shape
        self._xy = lattice.xy_px
        self._velocity = np.zeros_like(self._xy)
        self._strength = lattice.strength
        return True

    def _track(self, image: NDArray[np.uint8], captured_ns: int) -> MarkerField:
        assert self._lattice is not None
        assert self._detector is not None
        lattice = self._lattice
        spots = self._detector.detect(image, max(1.0, self.settings.threshold * self._strength * 0.5))
        spots = self._bright_enough(spots)
        view = View(image.shape[1], image.shape[0], 0.6 * lattice.diameter_px)
        if len(spots.strength) < 4:
            return self._lost(captured_ns, f"{len(spots.strength)} markers in sight")
        best = self._best_match(spots.xy_px, view, captured_ns)
        visible = view.contains(best.xy_px)
        share = best.valid.sum() / max(1, min(int(visible.sum()), best.valid.size))
        if share < self.settings.lost_share or not visible.any():
            return self._lost(captured_ns, f"{best.valid.sum()} of {best.valid.size} markers matched")
        jump_px = _typical(best.xy_px - self._xy, best.valid)
        rival = self._at_rest(best, spots.xy_px, view) or self._rival(best, jump_px, spots.xy_px, view)
        if rival is not None or self._leaps(best, jump_px):
            self._xy = best.xy_px if rival is None else rival.xy_px
            self._last_ns = captured_ns
            return self._stale(captured_ns, "ambiguous", "the grid jumped by what may be a whole pitch")
        if best.scatter > _RANDOM:
            self._xy, self._last_ns = best.xy_px, captured_ns  # if it was torn before, it may be right now
            return self._lost(captured_ns, "the spots in sight follow no grid")
        self._remember(best, spots, captured_ns)
        status: TrackStatus = "tracking" if share >= self.settings.partial_share else "partial"
        valid = self._measured(best, spots, view)
        field = MarkerField(
            lattice.xy_px, best.xy_px - lattice.xy_px, valid, None, lattice.pitch_px, captured_ns, status
        )
        self._last_field = field
        return field

    def _rival(self, best: Match, jump_px: float, points: FloatArray, view: View) -> Match | None:
        """After a jump, a placement whole steps nearer to the markers' rest that explains the frame as well."""
        assert self._lattice is not None
        rest, pitch = self._lattice.xy_px, self._lattice.pitch_px
        if jump_px < _JUMP * pitch:
            return None
        home = _typical(best.xy_px - rest, best.valid)
        rivals = []
        for steps in _AROUND:
            place = match(best.xy_px - steps @ self._lattice.basis_px, rest, points, pitch, view, self._xy)
            nearer = place.valid.any() and _typical(place.xy_px - rest, place.valid) < home - 0.3 * pitch
            if nearer and place.misfit < best.misfit + _AS_WELL / max(rest.shape[:2]):
                rivals.append(place)
        return min(rivals, key=lambda place: place.misfit, default=None)

    def _at_rest(self, best: Match, points: FloatArray, view: View) -> Match | None:
        """The grid at rest, where that explains the whole frame and the placement that was followed does not.

        After a jump a grid may be followed a pitch off, so torn that each next frame confirms it.
        """
        assert self._lattice is not None
        rest, pitch = self._lattice.xy_px, self._lattice.pitch_px
        if _whole(best, len(points)):
            return None
        home = match(rest, rest, points, pitch, view, rest)
        if not _whole(home, len(points)) or home.misfit > self._level + _CALM:
            return None
        still = _typical(home.xy_px - rest, home.valid) < _STILL * pitch
        return home if still and _uneven(home, rest) < _EVENER * _uneven(best, rest) else None

    def _leaps(self, best: Match, jump_px: float) -> bool:
        """Whether an uncertain match carried the whole grid far."""
        assert self._lattice is not None
        return jump_px > _LEAP * self._lattice.pitch_px and best.misfit > self._level + _DOUBTFUL

    def _measured(self, best: Match, spots: Candidates, view: View) -> BoolArray:
        """Which markers [rows, cols] have a reliable position: followed, not carried to the image's border, and round.

        A marker cut by the border appears further inside than it is (one that was always cut is consistent), and one
        smeared where the gel is torn may be anywhere along the smear.
        """
        assert self._lattice is not None
        rest, diameter = self._lattice.xy_px, self._lattice.diameter_px
        room = view.room_px(best.xy_px)
        cut = (room < _WHOLE * diameter) & (room < view.room_px(rest) - _NEARER * diameter)
        tight = spots.tightness[best.spot]
        typical = float(median(tight[best.valid]))
        return np.asarray(best.valid & ~cut & (tight > _ROUND * typical), np.bool_)

    def _bright_enough(self, spots: Candidates) -> Candidates:
        """Drop spots that are weak relative to this frame's typical marker, so that exposure jumps change nothing."""
        assert self._lattice is not None
        if len(spots.strength) == 0:
            return spots
        typical = float(spots.strength[min(len(spots.strength) - 1, self._lattice.detected.size // 2)])
        keep = spots.strength > self.settings.threshold * typical
        return spots.only(keep)

    def _best_match(self, points: FloatArray, view: View, captured_ns: int) -> Match:
        assert self._lattice is not None
        rest, pitch = self._lattice.xy_px, self._lattice.pitch_px
        best = match(self._xy, rest, points, pitch, view, self._xy)
        calm = self._level + _CALM
        if best.misfit < calm:
            return best
        if self._last_ns is not None:
            elapsed_s = min((captured_ns - self._last_ns) * 1e-9, 0.1)
            moving = match(self._xy + self._velocity * np.float32(elapsed_s), rest, points, pitch, view, self._xy)
            best = min(best, moving, key=lambda rival: rival.misfit)
        if _whole(best, len(points)):
            return best  # every marker in its place and few surplus: a step off would lose a border row
        linked = reindex(points, rest, pitch, view, self._xy, best, self._level + _SETTLED)
        return best if self._jumps_in_vain(best, linked, len(points), view) else linked

    def _jumps_in_vain(self, best: Match, linked: Match, spots_n: int, view: View) -> bool:
        """Whether the grid stands still by one placement, and by ``linked`` jumps away and leaves its gaps.

        Hidden markers at a border look like a jump that carried them out of the picture. But few jumps are of a whole
        pitch to a tenth, and one that leaves most of the gaps explains nothing.
        """
        assert self._lattice is not None
        pitch, rest = self._lattice.pitch_px, self._lattice.xy_px
        stays, jumps = (_step(one.xy_px - self._xy, one.valid) for one in (best, linked))
        if np.hypot(*stays) >= _STILL * pitch or np.hypot(*jumps) <= _JUMP * pitch:
            return False
        if _typical(linked.xy_px - rest, linked.valid) < _typical(best.xy_px - rest, best.valid):
            return False
        left_n, gaps_n = (
            int((view.contains(self._xy + step) & ~one.valid).sum()) + spots_n - int(one.valid.sum())
            for one, step in ((linked, jumps), (best, stays))
        )
        return 2 * left_n > gaps_n

    def _remember(self, best: Match, spots: Candidates, captured_ns: int) -> None:
        if self._last_ns is not None:
            elapsed_s = max((captured_ns - self._last_ns) * 1e-9, 1e-3)
            self._velocity = (best.xy_px - self._xy) / np.float32(elapsed_s)
        self._xy = best.xy_px
        self._level += 0.1 * (min(best.misfit, self._level + 1.0) - self._level)
        strength = float(median(spots.strength))
        self._strength += 0.3 * (strength - self._strength)
        self._last_ns = captured_ns

    def _repeat(self, captured_ns: int, reason: str) -> MarkerField:
        return self._stale(captured_ns, "duplicate", reason)

    def _lost(self, captured_ns: int, reason: str) -> MarkerField:
        return self._stale(captured_ns, "lost", reason)

    def _stale(self, captured_ns: int, status: TrackStatus, reason: str) -> MarkerField:
        """The last field under a new stamp, with a status that marks it as no new evidence."""
        last = self._last_field
        if last is None:
            return empty_field(captured_ns, "no_grid", reason)
        valid = last.valid if status == "duplicate" else np.zeros_like(last.valid)
        return replace(last, valid=valid, captured_ns=captured_ns, status=status, reason=reason)


def _whole(match: Match, spots_n: int) -> bool:
    """Whether a placement has far fewer missing and surplus markers than the shortest row of the grid, and no tear.

    Looking for another takes 50 to 100 ms, which an arm in contact cannot wait for.
    """
    hits_n = int(match.valid.sum())
    return match.torn_n == 0 and (match.valid.size - hits_n) + (spots_n - hits_n) <= _SPARE * min(match.valid.shape)


def _step(steps: FloatArray, valid: BoolArray) -> FloatArray:
    """The median step [2] in px of the valid nodes; 0 without any."""
    return median(steps[valid]) if valid.any() else np.zeros(2, np.float32)


def _uneven(match: Match, rest: FloatArray) -> float:
    """Scatter in px of the valid nodes' motions from rest."""
    return float(np.linalg.norm((match.xy_px - rest)[match.valid].std(0)))


def _typical(step: FloatArray, valid: BoolArray) -> float:
    """Length in px of the median step [rows, cols, 2] of the valid nodes."""
    return float(np.linalg.norm(_step(step, valid)))


def _repeats(image: NDArray[np.uint8], before: NDArray[np.uint8]) -> bool:
    return cv2.norm(image, before, cv2.NORM_L1) < _SAME_GREY * image.size
