"""Turn of a hanging object in the hand as the gels show it, and the part of it that a blocked attempt leaves behind.

While an attempt presses, the markers in the middle of the contact turn with the object; those near the rim have lost
it. When the arm goes up, the gels stick and turn the object back by as much as they carry. The rest of the turn was a
slide: it stays, and no marker shows it any more. A turn by the object's own weight shows against the open gels as long
as it hangs.
"""

import math

import numpy as np
from numpy.typing import NDArray

from service.perception.observation import Observation, PairObservation

HANGS_DEG = 0.5  # shown by the markers; the true turn is larger. Upright objects in drawn cells show 0.15 deg at most
CARRIED = 0.25  # share of the largest motion: markers that move by more are carried by the object
GIVEN_BACK = 1.08  # the gels turn the object back by this times the markers' motion;
GOING_IN_DEG = 0.5  # at full depth, since the descent began. Free-standing objects show 0.15 deg at most
FEWEST_N = 4  # markers that determine a turn


def hangs_turned(both: PairObservation) -> tuple[float, str]:
    """By how much the gels show that its weight has turned an object, deg, and why it does not hang upright, or ""."""
    turn_deg = both_deg(*(_shown_rad(finger) for finger in both.fingers))
    if abs(turn_deg) <= HANGS_DEG:
        return turn_deg, ""
    why = f"it hangs turned by {abs(turn_deg):.1f} deg or more: take it nearer to its centre of mass, or grip harder"
    return turn_deg, why


def turned_going_in(both: PairObservation, hung: PairObservation | None) -> tuple[float, str]:
    """Turn at full depth since the descent began, deg, and why the object does not hang as it ``hung`` above, or "".

    Something in the gap may hold it askew. If the whole contact slides all the way down, its motion per frame is too
    small to be detected; against the open gels it shows.
    """
    turns_rad = [finger.slip.angle_rad for finger in both.fingers]
    slid_deg = both_deg(*(_shown_rad(finger) for finger in both.fingers))
    if hung is not None:
        slid_deg -= both_deg(*(_shown_rad(finger) for finger in hung.fingers))
    most_deg = max(abs(slid_deg), *(math.degrees(abs(turn_rad)) for turn_rad in turns_rad))
    why = "" if most_deg <= GOING_IN_DEG else f"the gels show it turned by {most_deg:.1f} deg on the way down"
    return both_deg(*turns_rad), why


def lasting_turn_deg(pressed: PairObservation, lifted: PairObservation) -> float:
    """Turn left in the hand by a blocked attempt, deg, signed as in the left finger's picture.

    ``pressed``: the last pair of the attempt, ``lifted``: one of the object hanging free after it. Both fingers see the
    same turn from opposite sides; one that has lost contact shows less of it, so the larger counts. NaN where one does
    not show it for lack of markers that moved with the object: held by an edge, or seen by a slow camera. The factor is
    fitted, see docs/decisions/0112.
    """
    left, right = pressed.fingers
    turns_deg = math.degrees(left.slip.angle_rad), -math.degrees(right.slip.angle_rad)
    back_deg = both_deg(*map(_back_rad, pressed.fingers, lifted.fingers))
    if not np.isfinite([*turns_deg, back_deg]).all():
        return math.nan
    return max(turns_deg, key=abs) - GIVEN_BACK * back_deg


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
