"""Turn of a hanging object in the hand, the part of it that a blocked attempt leaves behind, and how to undo it.

While an attempt presses, the markers in the middle of the contact turn with the object; those near the rim have lost
it. When the arm goes up, the gels stick and turn the object back by as much as they carry. The rest of the turn was a
slide: it stays, and no marker shows it any more. A turn by the object's own weight shows against the open gels as long
as it hangs. A tool that can tilt holds the object upright again.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.perception.observation import Observation, PairObservation

TURNED_DEG = 0.6  # an object counts as upright up to 2 deg, and the expectation errs by 0.15 deg per attempt
HANGS_DEG = 0.5  # shown by the markers; the true turn is larger. Upright objects in drawn cells show 0.15 deg at most
CARRIED = 0.25  # share of the largest motion: markers that move by more are carried by the object
GIVEN_BACK = 1.08  # the gels turn the object back by this times the markers' motion;
BEYOND_SHOWN = 1.3  # this times the rest stays: markers follow an object only partly
GOING_IN_DEG = 0.5  # at full depth, since the descent began. Free-standing objects show 0.15 deg at most
STANDS_DEG = 0.7  # at full depth, including the turn left by earlier attempts
TAKEN_BACK = 0.8  # share of the expected turn by which the tool is tilted: the likeliest turn, see decision 191
MOST_TILT_DEG = 1.5  # whatever the client allows: what has turned further is regrasped
LEAST_TILT_DEG = 0.15  # a smaller change of the tilt is not worth a move: the expectation errs by as much
FEWEST_N = 4  # markers that determine a turn


def hangs_turned(both: PairObservation, left_deg: float) -> str:
    """Why an object does not hang upright in the hand, or "".

    The gels show that its weight has turned it, alone or together with ``left_deg``, the turn left by earlier attempts.
    """
    turn_deg = both_deg(*(_shown_rad(finger) for finger in both.fingers))
    if not abs(turn_deg) <= HANGS_DEG:
        return (
            f"it hangs turned by {abs(turn_deg):.1f} deg or more: take it nearer to its centre of mass, or grip harder"
        )
    if not abs(turn_deg + left_deg) <= TURNED_DEG:
        return f"the attempts and its weight have turned the object by about {abs(turn_deg + left_deg):.1f} deg"
    return ""


def turned_going_in(both: PairObservation, hung: PairObservation | None, left_deg: float) -> str:
    """Why an object does not hang at full depth as it ``hung`` above, or "": something in the gap holds it askew.

    If the whole contact slides all the way down, its motion per frame is too small to be detected; against the open
    gels it shows. ``left_deg``: the turn left by earlier attempts.
    """
    turns_rad = [finger.slip.angle_rad for finger in both.fingers]
    slid_deg = both_deg(*(_shown_rad(finger) for finger in both.fingers))
    if hung is not None:
        slid_deg -= both_deg(*(_shown_rad(finger) for finger in hung.fingers))
    most_deg = max(abs(slid_deg), *(math.degrees(abs(turn_rad)) for turn_rad in turns_rad))
    all_deg = abs(left_deg + both_deg(*turns_rad))
    if not most_deg <= GOING_IN_DEG:
        return f"the gels show it turned by {most_deg:.1f} deg on the way down"
    if not all_deg <= STANDS_DEG:
        return f"the attempts and the way down have turned it by about {all_deg:.1f} deg"
    return ""


@dataclass(slots=True)
class LastingTurn:
    """The turn left by the blocked attempts with one grasp.

    ``deg``: the expected sum, signed as in the left finger's picture, known once the object hangs free again; NaN where
    the gels do not show it. ``tilt_deg``: of the tool about the fingers' axis, which holds the object by that much
    straighter; ``most_tilt_deg``: how far it may be tilted.
    """

    deg: float = 0.0
    tilt_deg: float = 0.0
    most_tilt_deg: float = 0.0
    _pressed: PairObservation | None = None

    def held_at(self, tilt_deg: float, most_tilt_deg: float) -> "LastingTurn":
        """This turn, with the tool tilted so far."""
        self.tilt_deg, self.most_tilt_deg = tilt_deg, most_tilt_deg
        return self

    def pressed(self, both: PairObservation | None) -> None:
        """An attempt was blocked, ``both`` its last pair; None if it does not show the object's turn."""
        self._pressed = both
        if both is None:
            self.deg = math.nan

    @property
    def left_deg(self) -> float:
        """The part of the turn that the tilt of the tool does not make up for."""
        return self.deg + self.tilt_deg / TAKEN_BACK

    def lifted(self, both: PairObservation) -> None:
        """Account for the object hanging free again; only the first pair after a blocked attempt counts."""
        if self._pressed is not None:
            self.deg += lasting_turn_deg(self._pressed, both)
            self._pressed = None

    def straightening(self) -> float | None:
        """The tilt of the tool that holds the object upright, deg; None if it does so already, or is not known."""
        wanted_deg = -TAKEN_BACK * self.deg
        if (
            not abs(wanted_deg) <= min(self.most_tilt_deg, MOST_TILT_DEG)
            or abs(wanted_deg - self.tilt_deg) < LEAST_TILT_DEG
        ):
            return None
        return wanted_deg

    def askew(self, both: PairObservation) -> str:
        """Why the object, hanging free, needs a regrasp before the next attempt, or ""."""
        return self._too_far() or hangs_turned(both, self.left_deg)

    def _too_far(self) -> str:
        if abs(self.left_deg) <= TURNED_DEG:
            return ""
        if math.isnan(self.deg):
            return "the gels do not show whether the last attempt has turned the object in the hand"
        return f"the blocked attempts have turned the object in the hand by about {abs(self.deg):.1f} deg"


def lasting_turn_deg(pressed: PairObservation, lifted: PairObservation) -> float:
    """Turn left in the hand by a blocked attempt, deg, signed as in the left finger's picture.

    ``pressed``: the last pair of the attempt, ``lifted``: one of the object hanging free after it. Both fingers see the
    same turn from opposite sides; one that has lost contact shows less of it, so the larger counts. NaN where one does
    not show it for lack of markers that moved with the object: held by an edge, or seen by a slow camera. The two
    factors are fitted, see docs/decisions/0112.
    """
    left, right = pressed.fingers
    turns_deg = math.degrees(left.slip.angle_rad), -math.degrees(right.slip.angle_rad)
    back_deg = both_deg(*map(_back_rad, pressed.fingers, lifted.fingers))
    if not np.isfinite([*turns_deg, back_deg]).all():
        return math.nan
    return BEYOND_SHOWN * (max(turns_deg, key=abs) - GIVEN_BACK * back_deg)


def _back_rad(pressed: Observation, lifted: Observation) -> float:
    """Turn of the markers in a finger's contact on lifting the object; NaN where too few are visible."""
    slip, before, after = pressed.slip, pressed.field, lifted.field
    if before.valid.shape != after.valid.shape:
        return math.nan
    contact = (slip.sticking | slip.slipping) & before.valid & after.valid
    if contact.sum() < FEWEST_N:
        return math.nan
    return _turn_rad(before.rest_px[contact], (before.displacement_px - after.displacement_px)[contact])


def _shown_rad(observation: Observation) -> float:
    """Mean turn of the markers that are displaced from their places in the open gel."""
    field = observation.field
    return carried_rad(field.rest_px[field.valid], field.displacement_px[field.valid])


def carried_rad(place: NDArray[np.float32], moved: NDArray[np.float32]) -> float:
    """Mean turn of the points that the object carries, of points [n, 2] that moved by [n, 2] in the same unit."""
    away = np.hypot(*moved.T)
    carried = away > CARRIED * float(away.max(initial=0.0))
    return _turn_rad(place[carried], moved[carried]) if carried.sum() >= FEWEST_N else 0.0


def both_deg(left_rad: float, right_rad: float) -> float:
    """Turn from both fingers, deg, signed as in the left one's picture: they look from opposite sides."""
    return math.degrees(0.5 * (left_rad - right_rad))


def _turn_rad(place_px: NDArray[np.float32], moved_px: NDArray[np.float32]) -> float:
    """The turn of points [n, 2] that moved by [n, 2], by least squares, small angles."""
    place = place_px - place_px.mean(0, dtype=np.float64)
    moved = moved_px - moved_px.mean(0, dtype=np.float64)
    return float((place[:, 0] * moved[:, 1] - place[:, 1] * moved[:, 0]).sum() / np.square(place).sum())
