"""One missing piece of evidence is a doubt: each check alone, on a descent in which all others are satisfied."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.contract import Sensor, wire
from service.decision.attempt import Attempt, Stage, nothing_held
from service.decision.claim import BLIND_S, GraspRecord, doubts, newest_age_s, pressed_mm, slid_mm, unclaimed
from service.decision.seating import Push
from service.perception.markers.field import field_from_gel
from service.perception.observation import Observation, PairObservation
from service.perception.pressing import Legs
from service.perception.slip.detector import SlipDetector

PERIOD_NS = 33_333_333
FRAMES = 76  # 25 mm at 10 mm/s


def observation(finger: str, bulge: float | None = 6.0, angle_rad: float = 0.0) -> Observation:
    field = field_from_gel(np.zeros((20, 21, 3), np.float32), 0, Sensor.load())
    slip = replace(SlipDetector().rearm(field), angle_rad=angle_rad)
    return Observation(finger, 0, 0, np.zeros((0, 0, 3), np.uint8), field, slip, None, {}, bulge)


def pair(left: float | None = 6.0, right: float | None = 6.0, turn_rad: float = 0.0) -> PairObservation:
    return PairObservation(observation("left", left, turn_rad), observation("right", right, -turn_rad))


def descent(**changes: object) -> Attempt:
    """A watched descent to full depth with a held object without a push."""
    arm = wire.Arm(insertion_id="one", attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0, gripper_width_mm=50.0)
    attempt = Attempt(arm, 0, generation=1, stage=Stage.STOPPED, reference=pair(), descending_ns=0)
    attempt.pushes = [Push(index * PERIOD_NS, 0.0, 0.0) for index in range(FRAMES)]
    attempt.ring.append(pair())
    attempt.stopped_ns, attempt.outcome = FRAMES * PERIOD_NS, "inserted"
    attempt.depth_mm, attempt.gripper_width_mm = 25.0, 50.0
    for name, value in changes.items():
        setattr(attempt, name, value)
    return attempt


def reasons(attempt: Attempt, grasp: GraspRecord | None = None) -> list[str]:
    return [doubt.reason for doubt in doubts(attempt, grasp or GraspRecord(width_mm=50.0))]


def test_a_watched_descent_with_a_held_object_is_an_insertion() -> None:
    assert reasons(descent()) == []


def test_one_finger_that_never_felt_the_object_may_go_on_feeling_nothing() -> None:
    attempt = descent(reference=pair(left=0.8))
    attempt.ring.append(pair(left=0.0))
    assert reasons(attempt) == []


@pytest.mark.parametrize("right", [None, 0.7])
def test_where_no_finger_showed_the_object_at_arming_both_must_feel_it_at_full_depth(right: float | None) -> None:
    """As under a grip that hides the markers: that a finger was not known to be touched is no reason to ask less."""
    attempt = descent(reference=pair(left=None, right=right))
    assert reasons(attempt) == []
    for left, reason in ((0.7, "not_held"), (None, "not_seen")):
        attempt.ring.append(pair(left=left, right=0.7))
        assert reasons(attempt) == [reason, "not_held"]


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"descending_ns": None}, "order"),
        ({"descending_ns": FRAMES * PERIOD_NS - 50_000_000}, "order"),
        ({"descending_ns": FRAMES * PERIOD_NS - 99_000_000}, "order"),
        ({"depth_mm": 0.0}, "depth"),
        ({"depth_mm": 23.9}, "depth"),
        ({"depth_mm": math.nan}, "depth"),
        ({"gripper_width_mm": 47.0}, "width"),
        ({"gripper_width_mm": None}, "width"),
        ({"reference": None}, "not_seen"),
        ({"pushes": []}, "push"),
        ({"broken": "left is gone"}, "not_seen"),  # the reference is of before
    ],
)
def test_one_thing_that_is_wrong_is_a_doubt(changes: dict[str, object], reason: str) -> None:
    assert reason in reasons(descent(**changes))


@pytest.mark.parametrize(("left", "reason"), [(0.9, "not_held"), (None, "not_seen")])
def test_a_finger_that_feels_nothing_any_more_or_does_not_tell_is_a_doubt(left: float | None, reason: str) -> None:
    attempt = descent()
    attempt.ring.append(pair(left=left))
    assert reasons(attempt) == [reason]


def pictured(both: PairObservation, touch: float) -> PairObservation:
    return PairObservation(replace(both.left, touch=touch), replace(both.right, touch=touch))


def test_a_flat_face_that_only_the_pictures_show_at_full_depth_is_still_felt_and_must_be() -> None:
    """Creep lifts the markers of a relaxing gel over their limit for a while; its picture shows the object."""
    for bulge in (0.8, 1.1):
        attempt = descent(reference=pictured(pair(left=bulge, right=bulge), 3.6))
        for touch, expected in ((3.5, []), (0.5, ["not_held", "not_held"])):
            attempt.ring.append(pictured(pair(left=0.8, right=0.9), touch))
            assert reasons(attempt) == expected


@given(first=st.integers(0, FRAMES - 10), blind_n=st.integers(0, 60))
def test_a_descent_is_claimed_only_if_no_part_of_it_was_blind_for_long(first: int, blind_n: int) -> None:
    gone = range(first, min(first + blind_n, FRAMES - 1))
    kept = [push for index, push in enumerate(descent().pushes) if index not in gone]
    blind_s = (len(gone) + 1) * PERIOD_NS * 1e-9
    doubts = reasons(descent(pushes=kept))
    if blind_s > BLIND_S + 0.04:
        assert doubts == ["not_seen"]
    if blind_s < BLIND_S - 0.04:
        assert doubts == []


def test_a_slow_arm_may_be_blind_for_the_same_way() -> None:
    kept = [push for index, push in enumerate(descent().pushes) if not 10 <= index < 20]
    assert reasons(descent(pushes=kept, speed_mm_s=10.0)) == ["not_seen"]
    assert reasons(descent(pushes=kept, speed_mm_s=5.0, start_mm=12.5)) == []
    assert reasons(descent(pushes=kept, speed_mm_s=5.0)) == ["not_seen"], "it went faster than it said"
    assert reasons(descent(pushes=kept)) == ["not_seen"]


@pytest.mark.parametrize(("first", "doubted"), [(10, ["not_seen"]), (55, [])])
def test_a_slow_end_of_a_descent_excuses_no_longer_blind_way_before_it(first: int, doubted: list[str]) -> None:
    """0.43 s without a pair are 4.3 mm on the leg at 10 mm/s, and 2.2 mm on the one at 5 mm/s that follows it."""
    slow_ns, legs = 46 * PERIOD_NS, Legs()
    legs.add(0, 10.0)
    legs.add(slow_ns, 5.0)
    kept = [push for index, push in enumerate(descent().pushes) if not first <= index < first + 12]
    assert reasons(descent(pushes=kept, legs=legs, leg_ns=slow_ns, speed_mm_s=5.0, start_mm=20.0)) == doubted


def test_an_object_that_was_turned_on_the_way_down_is_not_claimed() -> None:
    attempt = descent()
    attempt.ring.append(pair(turn_rad=0.02))
    assert reasons(attempt) == ["moved_in_hand"]


@pytest.mark.parametrize("press", ["blocked", "unfollowed", "in an earlier grasp", "none"])
def test_after_a_press_a_gap_is_known_only_where_the_neighbours_stay(press: str) -> None:
    grasp = GraspRecord()
    grasp.begins(50.0, "", tried=press == "in an earlier grasp")
    if press in {"blocked", "unfollowed"}:
        getattr(grasp, press)(descent(depth_mm=5.0, outcome="blocked"))
    grasp.begins(50.0, "", tried=False)  # armed again
    grasp.tilt.unknown = ""
    attempt = descent()
    assert reasons(attempt, grasp) == ([] if press == "none" else ["neighbours"])
    attempt.arm = attempt.arm.model_copy(update={"neighbours_stay": True})
    assert reasons(attempt, grasp) == []


def test_what_was_pressed_too_far_is_not_claimed() -> None:
    assert reasons(descent(), GraspRecord(50.0, pressed_mm=5.1)) == ["moved_in_hand"]
    assert reasons(descent(), GraspRecord(50.0, pressed_mm=4.9)) == []


def test_only_a_turn_is_mended_by_taking_the_object_afresh() -> None:
    turned, pushed = (wire.Doubt(reason=reason, detail="") for reason in ("moved_in_hand", "push"))
    assert [unclaimed(doubts, afresh=True) for doubts in ((), (turned,), (turned, pushed))] == [
        None,
        "afresh",
        "not_confirmed",
    ]
    assert unclaimed((turned,), afresh=False) == "not_confirmed"


@pytest.mark.parametrize(("touch", "held"), [(None, False), (0.5, False), (1.4, True)])
def test_a_stiff_gel_whose_markers_hardly_move_shows_a_held_object_in_its_picture(
    touch: float | None, held: bool
) -> None:
    both = pair(left=0.7, right=0.8)
    assert nothing_held(both)
    shown = replace(both, right=replace(both.right, touch=touch))
    assert bool(nothing_held(shown)) != held


def weighed(both: PairObservation, left: float | None, right: float | None) -> PairObservation:
    return PairObservation(replace(both.left, weight=left), replace(both.right, weight=right))


def test_what_only_its_weight_has_shown_must_still_be_half_there_at_full_depth() -> None:
    attempt = descent(reference=weighed(pair(left=0.7, right=0.6), 1.2, 1.2))
    for left, right, expected in ((0.36, 0.31, []), (0.34, 0.6, ["not_held"]), (0.7, 0.2, ["not_held"])):
        attempt.ring.append(pair(left=left, right=right))
        assert reasons(attempt) == expected


def blocked(contact_s: float, grip_mm: float, rate_hz: float = 30.0) -> Attempt:
    """An attempt at 10 mm/s whose markers follow the object from ``contact_s`` on, for ``grip_mm`` at most, of 2 mm."""
    stamps_s = np.arange(0.0, contact_s + 0.2, 1 / rate_hz)
    pushes = [Push(int(at_s * 1e9), 0.0, 0.0, min(max(0.0, 10 * (at_s - contact_s)), grip_mm)) for at_s in stamps_s]
    return descent(pushes=pushes, stopped_ns=int((contact_s + 0.2) * 1e9), depth_mm=10 * (contact_s + 0.2))


@given(st.floats(0.2, 1.0), st.floats(0.2, 1.9), st.sampled_from([30.0, 60.0, 120.0]))
def test_the_way_that_an_object_slid_is_what_the_arm_went_on_after_the_markers_stopped(
    contact_s: float, grip_mm: float, rate_hz: float
) -> None:
    assert slid_mm(blocked(contact_s, grip_mm, rate_hz)) == pytest.approx(2.0 - grip_mm, abs=12.0 / rate_hz)


def test_a_way_is_that_of_the_leg_in_which_it_was_gone() -> None:
    """At 10 mm/s in both of two legs, the second one announced at 2 mm."""
    whole = replace(blocked(0.5, 1.0), onset_ns=int(0.5e9))
    legs = replace(whole, leg_ns=int(0.2e9), start_mm=2.0)
    assert slid_mm(legs) == pytest.approx(slid_mm(whole))
    assert pressed_mm(legs) == pytest.approx(pressed_mm(whole)) == pytest.approx(2.0)
    paused = replace(whole, stopped_ns=int(0.9e9), onset_ns=int(0.7e9), legs=Legs())
    paused.legs.add(0, 10.0)
    paused.legs.pauses(int(0.3e9), 0.2)
    assert pressed_mm(paused) == pytest.approx(2.0), "it stood for 0.2 s before it touched"
    for attempt in (replace(whole, speed_mm_s=0.1, stopped_ns=int(0.4e9)), replace(legs, speed_mm_s=16.1)):
        grasp = GraspRecord(50.0)
        grasp.blocked(attempt)
        assert math.isnan(grasp.tilt.deg)


def test_an_object_that_slid_far_or_was_not_seen_has_turned_by_nobody_knows_how_much() -> None:
    for attempt in (blocked(0.5, 0.3), descent(stopped_ns=None), descent(pushes=[])):
        grasp = GraspRecord(50.0)
        grasp.blocked(attempt)
        assert math.isnan(grasp.tilt.deg)


@pytest.mark.parametrize(
    ("speed_mm_s", "slid_mm", "known"),
    [(10.0, 0.0, True), (10.0, 0.2, False), (None, 0.0, True), (10.1, 0.0, True), (10.9, 0.0, False)],
)
def test_what_an_arm_turns_before_a_picture_shows_it_counts_to_what_slid(
    speed_mm_s: float | None, slid_mm: float, known: bool
) -> None:
    grasp = GraspRecord(50.0)
    grasp.blocked(replace(blocked(0.5, 2.0 - slid_mm, 240.0), speed_mm_s=speed_mm_s))
    assert math.isfinite(grasp.tilt.deg) == known


@pytest.mark.parametrize(("slower", "known_n"), [(1.0, 1), (1.2, 2), (1.4, 3), (2.0, 6)])
def test_what_late_pictures_may_hide_adds_up_over_the_attempts_with_a_grasp(slower: float, known_n: int) -> None:
    """Squares of 75 ms at 10 mm/s, or at a share of that speed."""
    attempt = blocked(0.5, 2.0, 240.0)
    assert attempt.stopped_ns is not None
    attempt, grasp, known = replace(attempt, depth_mm=attempt.depth_mm / slower), GraspRecord(50.0), list[bool]()
    for _ in range(7):
        grasp.blocked(attempt)
        known.append(math.isfinite(grasp.tilt.deg))
    assert known == [True] * known_n + [False] * (7 - known_n)


def test_a_grasp_remembers_its_strongest_push_and_its_furthest_press() -> None:
    grasp = GraspRecord(50.0)
    blocked = descent(depth_mm=8.0, onset_ns=FRAMES * PERIOD_NS // 2)
    blocked.pushes.append(Push(0, 0.3, 0.4))
    grasp.blocked(blocked)
    grasp.blocked(descent(depth_mm=5.0))
    assert grasp.blocked_pitch == pytest.approx(0.4)
    assert grasp.pressed_mm == pytest.approx(4.0)


def test_a_grasp_that_bore_little_remembers_little() -> None:
    grasp = GraspRecord(50.0)
    assert (grasp.blocked_pitch, grasp.pressed_mm) == (0.0, 0.0)
    light = descent(pushes=[Push(0, 0.03, 0.03)])
    grasp.blocked(light)
    assert (grasp.blocked_pitch, grasp.pressed_mm) == (0.03, 0.0)


def test_a_descent_as_fast_as_any_may_be_is_one() -> None:
    assert "order" not in reasons(descent(descending_ns=FRAMES * PERIOD_NS - 101_000_000))


def test_the_newest_pair_is_as_old_as_its_stamp_if_it_shows_the_load() -> None:
    pushes = [Push(1_000_000_000, 0.1, 0.1), Push(1_500_000_000, 0.2, 0.2)]
    assert newest_age_s(pushes, 1_750_000_000) == pytest.approx(0.25)
    assert newest_age_s([*pushes, Push(1_700_000_000, math.nan, 0.2)], 1_750_000_000) == math.inf
    assert newest_age_s([], 1_750_000_000) == math.inf
