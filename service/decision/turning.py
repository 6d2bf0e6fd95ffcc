"""How far an object hangs turned in the hand, and how far a blocked attempt has left it so.

Where the gels still stick in the middle, the markers there turn with the object; nearer to the rim of the contact they
have let go. What the object has turned beyond what the contact as a whole carries has slid: it stays when the arm goes
up, and nothing shows it any more. What its own weight turns shows against the open gels, as long as it hangs.
"""

import math

import numpy as np
from numpy.typing import NDArray

from service.perception.observation import Observation, PairObservation

TURNED_DEG = 0.6  # an object counts as upright up to 2 deg, and the expectation errs by 0.25 deg an attempt
HANGS_DEG = 0.5  # shown by the markers; more has slid. Upright ones in drawn cells show 0.15 deg at most
CARRIED = 0.25  # of the largest motion: markers that move by more are carried by the object
GIVEN_BACK = 1.1  # of what the contact carries, the gels turn back
BEYOND_SHOWN = 1.4  # times what the core shows: it follows the object less than all the way
GOING_IN_DEG = 0.5  # at full depth, since the descent began. Objects that stand free show 0.15 deg at most
STANDS_DEG = 0.7  # at full depth, with what earlier attempts have left
FEWEST_N = 4  # markers that determine a turn


def hangs_turned(both: PairObservation, left_deg: float = 0.0) -> str:
    """Why an object does not hang upright in the hand, or nothing.

    The gels show that its weight has turned it, or do so together with ``left_deg``, what earlier attempts have left of
    a turn.
    """
    turn_deg = _both_deg(*(_shown_rad(finger) for finger in both.fingers))
    if not abs(turn_deg) <= HANGS_DEG:
        return (
            f"it hangs turned by {abs(turn_deg):.1f} deg or more: take it nearer to its centre of mass, or grip harder"
        )
    if not abs(turn_deg + left_deg) <= TURNED_DEG:
        return f"the attempts and its weight have turned the object by about {abs(turn_deg + left_deg):.1f} deg"
    return ""


def turned_going_in(both: PairObservation, hung: PairObservation | None, left_deg: float = 0.0) -> str:
    """Why an object does not hang at full depth as it ``hung`` above, or nothing: something in the gap holds it askew.

    A whole contact that slides all the way down moves too little at a time to be a motion; against the open gels it
    shows. ``left_deg``: what earlier attempts have left of a turn.
    """
    turns_rad = [finger.slip.angle_rad for finger in both.fingers]
    slid_deg = _both_deg(*(_shown_rad(finger) for finger in both.fingers))
    if hung is not None:
        slid_deg -= _both_deg(*(_shown_rad(finger) for finger in hung.fingers))
    most_deg = max(abs(slid_deg), *(math.degrees(abs(turn_rad)) for turn_rad in turns_rad))
    all_deg = abs(left_deg + _both_deg(*turns_rad))
    if not most_deg <= GOING_IN_DEG:
        return f"the gels show it turned by {most_deg:.1f} deg on the way down"
    if not all_deg <= STANDS_DEG:
        return f"the attempts and the way down have turned it by about {all_deg:.1f} deg"
    return ""


def lasting_turn_deg(both: PairObservation | None) -> float:
    """What stays in the hand of the turn that the markers show at standstill, deg, signed as the left finger shows it.

    ``both``: the last pair of a blocked attempt. Both fingers see the same turn from opposite sides; one that has let
    go shows less of it, so the larger counts. NaN where one does not show it, for want of markers that went with the
    object: held by an edge, or seen by a slow camera. Against 494 blocked attempts in drawn cells (bristle tier,
    simulated; BEYOND_SHOWN is fitted to them, GIVEN_BACK to 1,131 presses by 1.65 mm) it correlates by 0.94 with what
    stayed and errs by 0.25 deg, by 0.8 deg in one of a hundred. No reach has to be known.
    """
    if both is None:
        return math.nan
    left, right = both.fingers
    object_rad = max(left.slip.angle_rad, -right.slip.angle_rad, key=abs)
    carried_rad = 0.5 * (_carried_rad(left) - _carried_rad(right))
    slid_rad = abs(object_rad) - GIVEN_BACK * math.copysign(1.0, object_rad) * carried_rad
    if not math.isfinite(slid_rad):
        return math.nan
    return BEYOND_SHOWN * math.degrees(math.copysign(max(0.0, slid_rad), object_rad))


def _carried_rad(observation: Observation) -> float:
    """The mean turn of all markers in a finger's contact, by least squares; NaN where there are too few."""
    slip, contact = observation.slip, observation.slip.sticking | observation.slip.slipping
    if contact.sum() < FEWEST_N:
        return math.nan
    return slip.angle_rad + _turn_rad(observation.field.rest_px[contact], slip.residual_px[contact])


def _shown_rad(observation: Observation) -> float:
    """The mean turn of the markers that are away from where they lie in the open gel."""
    field = observation.field
    away = np.where(field.valid, np.hypot(*np.moveaxis(field.displacement_px, -1, 0)), 0.0)
    carried = away > CARRIED * float(away.max(initial=0.0))
    if carried.sum() < FEWEST_N:
        return 0.0
    return _turn_rad(field.rest_px[carried], field.displacement_px[carried])


def _both_deg(left_rad: float, right_rad: float) -> float:
    """What both fingers show together, deg, signed as the left one shows it: they look from opposite sides."""
    return math.degrees(0.5 * (left_rad - right_rad))


def _turn_rad(place_px: NDArray[np.float32], moved_px: NDArray[np.float32]) -> float:
    """The turn of points [n, 2] that moved by [n, 2], by least squares, small angles."""
    place = place_px - place_px.mean(0, dtype=np.float64)
    moved = moved_px - moved_px.mean(0, dtype=np.float64)
    return float((place[:, 0] * moved[:, 1] - place[:, 1] * moved[:, 0]).sum() / np.square(place).sum())
