"""The evidence required before full depth is claimed to be an insertion.

Absence of a signal is no evidence: each check requires a measurement, and a missing measurement is a doubt. One doubt
is enough for "not confirmed".
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from service.contract.wire import Cause, Doubt, DoubtReason
from service.contract.wire_parts import DEPTH_TOLERANCE_MM
from service.decision.attempt import Attempt
from service.decision.held_tilt import UNSEEN, HeldTilt, Touch
from service.decision.seating import NOISE_PITCH, Push, seating_evidence, stood_pitch, strongest_push
from service.perception.observation import Observation, PairObservation
from service.perception.turning import turned_going_in

Doubts = tuple[Doubt, ...]
FASTEST_MM_S = 250.0  # no guarded descent is faster: a depth reached sooner was not reached by a descent
WIDTH_CHANGE_MM = 1.0  # a held object keeps the fingers apart; the gel yields by less
BLIND_S = 0.25  # the longest part of a descent without a pair that shows the gels' load,
BLIND_MM = 2.5  # or the travel in which a slow arm may take longer
_ROUNDED_MM = 1e-6
SLID_MM = 0.8  # beyond this slide of the object, nothing shows how far it turned
LATE_S = 0.075  # possible delay of pictures: the object slides as the arm turns it before a picture shows it
ALL_LATE_MM = 0.95  # travel within that delay in all attempts with a grasp, added in squares
WEIGHED_SHARE = 0.5  # share of the gel's bulge under an object felt by weight alone; below it the object is lost
PRESSED_MM = 5.0  # beyond this press, a gel does not reliably bring its object back


@dataclass(slots=True)
class GraspRecord:
    """Evidence about this grasp from the attempts so far.

    ``width_mm`` is the gripper's at the first arming. ``blocked_pitch``: the strongest push on the gels in the blocked
    attempts, marker pitches. ``pressed_mm``: the longest press of a blocked attempt after its contact. ``late_mm``: the
    travel in all of them that late pictures may have hidden, added in squares. ``tilt``: the object's in the hand.
    ``tried``: an attempt before was blocked or had no known end, in this grasp or an earlier one.
    """

    width_mm: float | None = None
    blocked_pitch: float = 0.0
    pressed_mm: float = 0.0
    late_mm: float = 0.0
    tilt: HeldTilt = field(default_factory=HeldTilt)
    tried: bool = False

    def blocked(self, attempt: Attempt) -> None:
        self.tried = True
        self.blocked_pitch = max(self.blocked_pitch, strongest_push(attempt.pushes))
        self.pressed_mm = max(self.pressed_mm, pressed_mm(attempt))
        late_mm = LATE_S * max(attempt.speed_mm_s or 0.0, went_mm_s(attempt))
        self.late_mm = math.hypot(self.late_mm, late_mm)
        on_mm = slid_mm(attempt)
        followed = late_mm + on_mm <= SLID_MM and self.late_mm <= ALL_LATE_MM
        slid_deg = math.degrees(on_mm / (0.5 * attempt.arm.gap_width_mm))  # about the edge of the other top
        self.tilt.pressed(attempt.ring[-1] if attempt.ring and followed else None, touch_of(attempt), slid_deg)

    def begins(self, width_mm: float | None, unknown: str, *, tried: bool) -> None:
        """The first arming. ``unknown``: why it is not known how the object hangs, or "". ``tried``: before this."""
        self.width_mm, self.tilt.unknown = width_mm, self.tilt.unknown or unknown
        self.tried = self.tried or tried

    def unfollowed(self, attempt: Attempt) -> None:
        """The arm went down in an attempt of which no end is known: the object may have turned in the hand."""
        self.tried = True
        self.blocked_pitch = max(self.blocked_pitch, strongest_push(attempt.pushes))
        self.tilt.unknown = self.tilt.unknown or UNSEEN


def went_mm_s(attempt: Attempt) -> float:
    """Mean speed of a descent, or of its last leg, pauses left out; infinite if its time is unknown."""
    began, stopped = attempt.leg_ns or attempt.descending_ns, attempt.stopped_ns
    if began is None or stopped is None or not (going_ns := attempt.legs.going_ns(began, stopped)) > 0:
        return math.inf
    return (attempt.depth_mm - attempt.start_mm) * 1e9 / going_ns


def pressed_mm(attempt: Attempt) -> float:
    """Travel of the arm after the onset of motion, mm, on its last leg at its mean speed; 0 without an onset."""
    began, onset, stopped = attempt.descending_ns, attempt.onset_ns, attempt.stopped_ns
    if began is None or onset is None or stopped is None or not began < onset < stopped:
        return 0.0
    leg = began if attempt.leg_ns is None else attempt.leg_ns
    before_mm = max(0.0, attempt.legs.travel_mm(onset, leg))
    return before_mm + went_mm_s(attempt) * attempt.legs.going_ns(max(onset, leg), stopped) * 1e-9


def touch_of(attempt: Attempt) -> Touch | None:
    """Where a blocked attempt touched; None without an onset, after a pause, or where the tops may not be level.

    Its height counts from full depth: a client may arm each attempt from another one.
    """
    level_mm, pressed = attempt.arm.tops_level_mm, pressed_mm(attempt)
    if level_mm is None or attempt.paused_in_press or not 0.0 < pressed < math.inf:
        return None
    return Touch(attempt.depth_mm - pressed - attempt.arm.expected_depth_mm, 0.5 * attempt.arm.gap_width_mm, level_mm)


def slid_mm(attempt: Attempt) -> float:
    """Travel of a blocked attempt after the gels had stopped following the object, mm; NaN if unknown.

    While the gels stick, the markers move for as long as the arm does. The time of the middle four fifths of their
    motion gives the time at which they stopped. A camera's latency makes the slide appear smaller.
    """
    began, stopped = attempt.descending_ns, attempt.stopped_ns
    if began is None or stopped is None:
        return math.nan
    moves = [((push.captured_ns - began) * 1e-9, push.moved_pitch) for push in attempt.pushes]
    lasted_s = (stopped - began) * 1e-9
    moves = [(at_s, moved) for at_s, moved in moves if at_s <= lasted_s and math.isfinite(moved)]
    if not moves or not max(moved for _, moved in moves) > 0.0:
        return math.nan
    stamps_s, moved = np.array(moves).T
    grown = np.maximum.accumulate(moved)
    from_s, to_s = np.interp([0.1, 0.9], grown / grown[-1], stamps_s)
    slid_s = lasted_s - to_s - (to_s - from_s) / 8
    return went_mm_s(attempt) * max(float(slid_s), 0.0)


# ---- at full depth ----------------------------------------------------------------------------------------------


def doubts(attempt: Attempt, grasp: GraspRecord) -> Doubts:
    """Doubts that keep this attempt's full depth from being claimed; empty if all evidence is there."""
    checks = (_order, _depth, _watched, _held, _width, _pushed, _moved_in_hand, _neighbours)
    return tuple(doubt for check in checks for doubt in check(attempt, grasp))


def unclaimed(doubts: Doubts, *, afresh: bool) -> Cause | None:
    """The cause for which an insertion ends at full depth, None without doubts.

    ``afresh``: the client can regrasp an object upright, which corrects a turn and nothing else.
    """
    if not doubts:
        return None
    return "afresh" if afresh and {doubt.reason for doubt in doubts} == {"moved_in_hand"} else "not_confirmed"


def _doubt(reason: DoubtReason, detail: str, value: float | None = None, bound: float | None = None) -> Doubt:
    value, bound = (number if number is not None and math.isfinite(number) else None for number in (value, bound))
    return Doubt(reason=reason, detail=detail, value=value, bound=bound)


def _order(attempt: Attempt, _: GraspRecord) -> Iterator[Doubt]:
    if attempt.descending_ns is None:
        yield _doubt("order", "no descent was announced before full depth was")
        return
    lasted_s = ((attempt.stopped_ns or 0) - attempt.descending_ns) / 1e9
    least_s = attempt.depth_mm / FASTEST_MM_S
    if not lasted_s >= least_s:
        detail = f"{attempt.depth_mm:.1f} mm in {lasted_s:.2f} s is no guarded descent"
        yield _doubt("order", detail, lasted_s, least_s)


def _depth(attempt: Attempt, _: GraspRecord) -> Iterator[Doubt]:
    least_mm = attempt.arm.expected_depth_mm - DEPTH_TOLERANCE_MM
    if not attempt.depth_mm >= least_mm:
        detail = f"stopped at {attempt.depth_mm:.1f} mm, full depth begins at {least_mm:.1f} mm"
        yield _doubt("depth", detail, attempt.depth_mm, least_mm)


def _watched(attempt: Attempt, _: GraspRecord) -> Iterator[Doubt]:
    """The gels were read throughout: no gap between readable pairs, before the first or after the last."""
    if attempt.broken:
        yield _doubt("not_seen", f"a camera failed during the attempt: {attempt.broken}")
    if attempt.descending_ns is None or attempt.stopped_ns is None:
        return
    read = [push.captured_ns for push in attempt.pushes if math.isfinite(push.weaker_pitch)]
    on_the_way = [stamp for stamp in read if attempt.descending_ns < stamp < attempt.stopped_ns]
    gaps = list(pairwise([attempt.descending_ns, *on_the_way, attempt.stopped_ns]))
    blind_s = max(until_ns - since_ns for since_ns, until_ns in gaps) / 1e9
    most_s = max(BLIND_S, BLIND_MM / max(attempt.speed_mm_s or math.inf, went_mm_s(attempt)))
    if not blind_s <= most_s:
        detail = f"for {blind_s:.2f} s of the descent no pair showed what the gels carry"
        yield _doubt("not_seen", detail, blind_s, most_s)
        return
    # That is the speed of the last leg: on a faster one before it the arm goes further in this time.
    long = [gap for gap in gaps if gap[1] - gap[0] > BLIND_S * 1e9]
    blind_mm = max((attempt.legs.travel_mm(*gap) for gap in long), default=0.0)
    if not blind_mm <= BLIND_MM + _ROUNDED_MM:
        detail = f"for {blind_mm:.1f} mm of the descent no pair showed what the gels carry"
        yield _doubt("not_seen", detail, blind_mm, BLIND_MM)


def _held(attempt: Attempt, _: GraspRecord) -> Iterator[Doubt]:
    """Each finger that felt the object before the descent still feels it."""
    reference = attempt.reference
    if reference is None or not attempt.ring:
        yield _doubt("not_seen", "no pair shows the object in the hand")
        return
    for before, now in zip(reference.fingers, attempt.ring[-1].fingers, strict=True):
        shows, least = _shown(before, now, reference)
        if shows is None:
            yield _doubt("not_seen", f"the {now.finger} gel does not show whether it is touched")
        elif shows < least:
            yield _doubt("not_held", f"the {now.finger} gel looks as if nothing touches it", shows, least)


def _shown(before: Observation, now: Observation, reference: PairObservation) -> tuple[float | None, float]:
    """What a finger shows of the object's touch, and the least that it must still show.

    A finger that felt the object by its markers or in the picture must still feel it by either. Where both showed its
    weight only, the markers must keep their share; where only the other finger felt it, nothing is asked of this one.
    Where neither did, and one was not visible, both must feel it now.
    """
    felt = any(finger.feels for finger in reference.fingers)
    if before.feels or not (felt or reference.looks_open):
        return now.felt, 1.0
    weighed = reference.looks_open and before.bulge is not None
    return now.bulge, WEIGHED_SHARE * (before.bulge or 0.0) if weighed else 0.0


def _width(attempt: Attempt, grasp: GraspRecord) -> Iterator[Doubt]:
    before, now = grasp.width_mm, attempt.gripper_width_mm
    if before is None:
        return  # without a width at arming, a change is unknown; the gels have to show it
    if now is None or not abs(now - before) <= WIDTH_CHANGE_MM:
        text = "nothing" if now is None else f"{now:.1f} mm"
        change = None if now is None else abs(now - before)
        yield _doubt("width", f"the gripper held {before:.1f} mm and now tells {text}", change, WIDTH_CHANGE_MM)


def _pushed(attempt: Attempt, grasp: GraspRecord) -> Iterator[Doubt]:
    began_ns = attempt.armed_ns if attempt.descending_ns is None else attempt.descending_ns
    seating = seating_evidence(attempt.pushes, began_ns, grasp.blocked_pitch)
    if not seating.seated:
        yield _doubt("push", str(seating), seating.push_pitch, seating.bound_pitch)
    stood = stood_pitch(attempt.reference)
    if not grasp.blocked_pitch and stood >= NOISE_PITCH:  # after a press, a gel that relaxes may still show that one
        detail = (
            f"the gels carried a push of {stood:.3f} marker pitches before the descent: the object stood on something"
        )
        yield _doubt("push", detail, stood, NOISE_PITCH)


def _moved_in_hand(attempt: Attempt, grasp: GraspRecord) -> Iterator[Doubt]:
    if attempt.ring:
        turn_deg, why = turned_going_in(attempt.ring[-1], attempt.reference)
        if not why and not grasp.tilt.upright(turn_deg):
            why = f"it is {grasp.tilt}, and turned by {turn_deg:.1f} deg on the way down"
        if why:
            yield _doubt("moved_in_hand", why)
    if not grasp.pressed_mm <= PRESSED_MM:
        detail = f"an attempt went on for {grasp.pressed_mm:.1f} mm after its contact: the object was moved in the hand"
        yield _doubt("moved_in_hand", detail, grasp.pressed_mm, PRESSED_MM)


def _neighbours(attempt: Attempt, grasp: GraspRecord) -> Iterator[Doubt]:
    """The gap is where it was, and as wide: a foot that takes its neighbour along feels like one that slides on it."""
    if grasp.tried and not attempt.arm.neighbours_stay:
        yield _doubt(
            "neighbours", "a press may have pushed a neighbour aside: the client does not state that they stay"
        )


def newest_age_s(pushes: Sequence[Push], now_ns: int) -> float:
    """Age of the newest pair that shows the gels' load, s; infinite without one."""
    if not pushes or not math.isfinite(pushes[-1].weaker_pitch):
        return math.inf
    return float(now_ns - pushes[-1].captured_ns) / 1e9
