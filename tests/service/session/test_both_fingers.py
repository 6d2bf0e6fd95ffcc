"""What both fingers say together: slides, an empty hand, age, and the facts about their gels."""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from service.contract import FramePair, TactileFrame
from service.perception.markers.field import empty_field
from service.perception.observation import Observation, PairObservation
from service.session.fingers import Fingers, gels_of
from tests.service.decision.test_claim import descent, observation, pair

PIXELS = np.zeros((2, 2, 3), np.uint8)
MS = 1_000_000


class Watch:
    """Shows what the test says that its finger shows, with the stamp of the frame."""

    gel_distance: float | None = None

    def __init__(self, shown: Observation) -> None:
        self.shown = shown

    def observe(self, frame: TactileFrame) -> Observation:
        return replace(self.shown, seq=frame.seq, captured_ns=frame.captured_ns)


class Hand:
    """Both fingers, shown pair by pair what is set for them."""

    def __init__(self, held: PairObservation | None = None) -> None:
        held = held or touched(2.0, 2.0)
        self.left, self.right = Watch(held.left), Watch(held.right)
        self.fingers, self.seq = Fingers(self.left, self.right), 0  # type: ignore[arg-type]

    def sees(self, both: PairObservation) -> PairObservation:
        self.left.shown, self.right.shown = both.left, both.right
        self.seq += 1
        for finger in ("left", "right"):
            self.fingers.observe(frame(finger, self.seq))
        return self.fingers.both()


def frame(finger: Any, seq: int = 0, captured_ns: int = 0) -> TactileFrame:
    return TactileFrame(finger, seq, captured_ns, PIXELS)


def touched(left: float | None, right: float | None, **changes: Any) -> PairObservation:
    both = pair()
    return PairObservation(replace(both.left, touch=left, **changes), replace(both.right, touch=right, **changes))


GONE = touched(0.1, 0.1, bulge=0.1)


def test_a_hand_that_has_lost_its_object_says_so_once_and_again_only_after_it_held_one_again() -> None:
    hand, attempt = Hand(), descent(outcome=None, reference=touched(2.0, 2.0))
    losses = []
    for both in [touched(2.0, 2.0)] * 2 + [GONE] * 4 + [touched(2.0, 2.0)] * 6 + [GONE] * 3:
        hand.sees(both)
        losses.append(bool(hand.fingers.emptied(attempt)))
    assert [index for index, now in enumerate(losses) if now] == [3, 13], "two empty pairs in a row"


def test_each_arming_begins_with_an_object_in_the_hand() -> None:
    hand, losses = Hand(), []
    for generation in (1, 2):
        attempt = descent(outcome=None, reference=touched(2.0, 2.0), generation=generation)
        for _ in range(3):
            hand.sees(GONE)
            losses.append(bool(hand.fingers.emptied(attempt)))
    assert losses == [False, True, False] * 2


def test_before_an_arming_and_at_full_depth_an_empty_hand_is_no_loss() -> None:
    for attempt in (descent(outcome=None, reference=None), descent(reference=touched(2.0, 2.0))):
        hand = Hand()
        for _ in range(4):
            hand.sees(GONE)
            assert hand.fingers.emptied(attempt) == ""


@pytest.mark.parametrize(
    ("reference", "now", "lost"),
    [
        (touched(2.0, 2.0, bulge=9.0), touched(0.1, 0.1, bulge=9.0), True),  # its picture felt it, and no longer does
        (touched(0.9, 0.9, bulge=3.0), touched(0.1, 0.1, bulge=1.1), False),  # only its markers felt it, and still do
        (touched(0.9, 0.9, bulge=3.0), touched(0.1, 0.1, bulge=0.9), True),
        (touched(None, None, bulge=3.0), touched(0.1, 0.1, bulge=1.1), False),
        (touched(0.9, 0.9, bulge=0.8), touched(0.9, 0.9, bulge=0.41), False),  # its weight alone: half of it is left
        (touched(0.9, 0.9, bulge=0.8), touched(0.9, 0.9, bulge=0.1), True),
        (touched(0.9, 0.9, bulge=3.0), touched(0.1, 0.1, bulge=None), False),  # unknown is not empty
        (touched(1.1, 1.1, bulge=3.0), touched(0.1, 0.1, bulge=3.0), True),
    ],
)
def test_a_finger_is_judged_by_what_felt_the_object_at_arming(
    reference: PairObservation, now: PairObservation, lost: bool
) -> None:
    hand, attempt = Hand(), descent(outcome=None, reference=reference)
    losses = []
    for both in [reference] * 2 + [now] * 3:
        hand.sees(both)
        losses.append(hand.fingers.emptied(attempt))
    assert any(losses) == lost


def slides(score: float | None) -> Callable[[Any], float | None]:
    return lambda _: score


def test_a_sliding_imprint_stops_the_arm_from_its_limit_on_and_not_over_a_stop_of_the_markers() -> None:
    hand = Hand()
    stopped = replace(observation("left").slip, state="gross_slip", score=3.0, reason="markers")
    blind = replace(observation("left"), field=empty_field(0, "no_grid", "no markers"))
    shown = {"held": observation("left"), "markers stop": replace(observation("left"), slip=stopped), "blind": blind}
    heard = {}
    for score in (None, -0.1, 0.0, 0.5):
        hand.fingers._witness = SimpleNamespace(update=slides(score))  # type: ignore[assignment]
        for name, one in shown.items():
            hand.left.shown = one
            slip = hand.fingers.observe(frame("left")).slip
            heard[name, score] = slip.reason if slip.stop else ""
            assert slip.score == {"markers": 3.0, "the imprint slides": 1.0}.get(slip.reason, slip.score)
    words = {"held": ("", "", "the imprint slides", "the imprint slides"), "blind": ("",) * 4}
    for name, expected in (words | {"markers stop": ("markers",) * 4}).items():
        assert tuple(heard[name, score] for score in (None, -0.1, 0.0, 0.5)) == expected


def test_only_frames_of_a_pair_that_were_not_perceived_are_missing() -> None:
    hand = Hand()
    one = FramePair(frame("left", 4, 40 * MS), frame("right", 7, 41 * MS))
    assert hand.fingers.missing(one) == [one.left, one.right]
    hand.fingers.observe(one.right)
    assert hand.fingers.missing(one) == [one.left]
    hand.fingers.observe(one.left)
    assert hand.fingers.missing(one) == []
    assert hand.fingers.missing(FramePair(one.left, frame("right", 8, 74 * MS))) != []


def test_frames_are_stale_by_their_older_finger_once_both_have_been_seen() -> None:
    hand = Hand().fingers
    hand.note(frame("left", 0, 100 * MS))
    assert (hand.age_ms(900 * MS), hand.stale(900 * MS, 150.0)) == (None, "")
    hand.note(frame("right", 0, 140 * MS))
    assert hand.age_ms(250 * MS) == pytest.approx(150.0)
    assert hand.stale(250 * MS, 150.0) == ""
    assert hand.stale(252 * MS, 150.0) == "a finger's newest frame is 152 ms old; hold until it is back"


def test_the_summary_tells_the_gel_that_is_stranger_and_the_finger_that_shows_fewer_markers() -> None:
    watches: Any = [SimpleNamespace(gel_distance=distance) for distance in (None, None)]
    assert gels_of(tuple(watches), None) == {}
    watches[1].gel_distance = 0.123456
    assert gels_of(tuple(watches), descent(reference=None)) == {"gel_distance": 0.1235}
    watches[0].gel_distance = 0.2
    both = pair()
    valid = np.arange(both.left.field.valid.size).reshape(both.left.field.valid.shape) >= 100
    left = replace(both.left, image=np.full((2, 3, 3), 100, np.uint8), field=replace(both.left.field, valid=valid))
    right = replace(both.right, image=np.array([[[1, 1, 2]]], np.uint8))
    facts = gels_of(tuple(watches), descent(reference=PairObservation(left, right)))
    assert facts == {"gel_distance": 0.2, "markers_share": 0.7619, "brightness_grey": 50.67}
    unseen = replace(right, field=empty_field(0, "no_grid", "no markers"))
    assert gels_of((), descent(reference=PairObservation(left, unseen)))["markers_share"] == 0.0
