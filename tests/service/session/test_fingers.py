"""When a hand counts as empty, which frames and ages belong to a pair, and what is told of the gels."""

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from service.contract import FramePair, TactileFrame
from service.decision.attempt import Attempt, Stage
from service.perception.markers.field import empty_field
from service.perception.observation import Observation, PairObservation
from service.session.fingers import Fingers, gels_of
from tests.service.decision.test_claim import descent, observation, pair

Felt = tuple[float | None, float | None]  # bulge and touch of a finger
HELD, EMPTY = (6.0, 6.0), (0.1, 0.1)


def felt(finger: Any, bulge: float | None, touch: float | None) -> Observation:
    return replace(observation(finger, bulge), touch=touch)


class Hand(Fingers):
    """Fingers whose perception is given."""

    def shows(self, left: Felt, right: Felt) -> PairObservation:
        self._observations = {"left": felt("left", *left), "right": felt("right", *right)}
        return self.both()


def hand() -> Hand:
    nobody: Any = SimpleNamespace()
    return Hand(nobody, nobody)


def armed(left: Felt, right: Felt, generation: int = 1) -> Attempt:
    reference = PairObservation(felt("left", *left), felt("right", *right))
    return descent(outcome=None, stage=Stage.ARMED, reference=reference, generation=generation)


def lost(one: Hand, attempt: Attempt, shown: Sequence[tuple[Felt, Felt]]) -> list[int]:
    """The pairs at which the hand is said to be empty."""
    pairs = []
    for index, (left, right) in enumerate(shown):
        one.shows(left, right)
        if one.emptied(attempt):
            pairs.append(index)
    return pairs


def test_a_hand_is_empty_once_both_gels_were_so_twice_and_that_is_said_once() -> None:
    shown = [(HELD, HELD), (EMPTY, HELD), (EMPTY, HELD), (EMPTY, EMPTY), (EMPTY, EMPTY), (EMPTY, EMPTY)]
    assert lost(hand(), armed(HELD, HELD), shown) == [4]


def test_an_attempt_armed_anew_begins_with_a_held_object() -> None:
    one = hand()
    assert lost(one, armed(HELD, HELD), [(EMPTY, EMPTY)] * 3) == [1]
    assert lost(one, armed(HELD, HELD), [(EMPTY, EMPTY)] * 3) == []
    assert lost(one, armed(HELD, HELD, generation=2), [(EMPTY, EMPTY)] * 3) == [1]


def test_what_was_set_down_at_full_depth_is_not_lost() -> None:
    attempt = armed(HELD, HELD)
    attempt.outcome = "inserted"
    assert lost(hand(), attempt, [(HELD, HELD), *[(EMPTY, EMPTY)] * 3]) == []


@pytest.mark.parametrize(
    ("reference", "later", "gone"),
    [
        (((6.0, 0.5), (6.0, 0.5)), (3.0, 0.5), False),
        (((6.0, 0.5), (6.0, 0.5)), (1.1, 0.5), False),
        (((6.0, 0.5), (6.0, 0.5)), (0.9, 0.5), True),
        (((6.0, None), (6.0, None)), (3.0, None), False),
        (((6.0, None), (6.0, None)), (0.9, None), True),
        (((6.0, 1.5), (6.0, 1.5)), (6.0, 0.5), True),
        (((6.0, 0.5), (6.0, 0.5)), (None, 0.5), False),
        (((0.8, 0.5), (0.8, 0.5)), (0.41, 0.5), False),
        (((0.8, 0.5), (0.8, 0.5)), (0.39, 0.5), True),
    ],
    ids=[
        "faint picture, markers hold",
        "faint picture, markers just hold",
        "faint picture, markers gone",
        "no picture, markers hold",
        "no picture, markers gone",
        "picture gone",
        "markers not found",
        "half of a weight",
        "less than half of a weight",
    ],
)
def test_a_finger_is_judged_by_what_it_showed_at_arming(reference: tuple[Felt, Felt], later: Felt, gone: bool) -> None:
    """By its picture, else by its markers; under a weight alone by the share of it that is left."""
    assert lost(hand(), armed(*reference), [reference, (later, later), (later, later)]) == ([2] if gone else [])


def frame(finger: Any, seq: int, captured_ns: int) -> TactileFrame:
    return TactileFrame(finger, seq, captured_ns, np.zeros((2, 2, 3), np.uint8))


def test_a_pairs_frame_is_missing_until_its_very_frame_was_perceived() -> None:
    one, pair = hand(), FramePair(frame("left", 0, 0), frame("right", 0, 0))
    assert [shown.finger for shown in one.missing(pair)] == ["left", "right"]
    one.shows(HELD, HELD)
    assert one.missing(pair) == []
    for newer in (FramePair(frame("left", 1, 0), pair.right), FramePair(frame("left", 0, 5), pair.right)):
        assert [shown.finger for shown in one.missing(newer)] == ["left"]


def test_a_pair_is_of_its_own_frames_though_newer_ones_of_a_finger_were_perceived_before() -> None:
    """The right camera's pictures arrive three periods later; of the left one's, the first was dropped."""
    watch: Any = SimpleNamespace(observe=lambda one: replace(observation(one.finger), seq=one.seq, captured_ns=one.seq))
    one = Fingers(watch, watch)
    for shown in [*(frame("left", seq, seq) for seq in range(1, 12)), frame("right", 8, 8)]:
        one.observe(shown)
    ready, late = (
        FramePair(frame("left", 8, 8), frame("right", 8, 8)),
        FramePair(frame("left", 0, 0), frame("right", 8, 8)),
    )
    assert one.missing(ready) == one.missing(late) == [], "a tracker would take an older frame for a repeated one"
    both = one.of(ready)
    assert both is not None
    assert (both.left.seq, both.right.seq, one.both().left.seq) == (8, 8, 11)
    assert one.of(late) is None


def test_frames_are_stale_by_the_finger_that_is_further_behind_and_not_before_both_have_one() -> None:
    watch: Any = SimpleNamespace(observe=lambda one: replace(observation(one.finger), captured_ns=one.captured_ns))
    one = Fingers(watch, watch)
    one.observe(frame("left", 0, 10_000_000))
    assert one.stale(10**12, 500.0) == ""
    one.observe(frame("right", 0, 40_000_000))
    assert one.stale(510_000_000, 500.0) == ""
    assert "is 501 ms old" in one.stale(511_000_000, 500.0)


@pytest.mark.parametrize(
    ("score", "state", "usable", "state_shown"),
    [
        (None, "hold", True, "hold"),
        (-0.01, "hold", True, "hold"),
        (0.0, "hold", True, "gross_slip"),
        (0.7, "hold", True, "gross_slip"),
        (0.7, "hold", False, "hold"),
        (0.7, "unknown", True, "unknown"),
    ],
)
def test_an_imprint_that_slides_stops_the_arm_unless_its_markers_did_or_cannot_be_read(
    score: float | None, state: Any, usable: bool, state_shown: str
) -> None:
    observed = felt("left", *HELD)
    field = observed.field if usable else replace(observed.field, status="no_grid")
    observed = replace(observed, field=field, slip=replace(observed.slip, state=state))
    watch: Any = SimpleNamespace(observe=lambda frame: replace(observed, finger=frame.finger))
    one = Fingers(watch, watch)
    asked = list[int]()
    one._witness = SimpleNamespace(update=lambda imprints: asked.append(len(imprints)) or score)  # type: ignore[assignment]
    for finger in ("left", "right"):
        slip = one.observe(frame(finger, 0, 0)).slip
        assert (slip.state, slip.score) == (state_shown, 1.0 if state_shown != state else observed.slip.score)
        assert slip.stop == (state_shown == "gross_slip")
    assert asked == [1, 2], "both fingers, once they were seen"


def test_slip_that_the_markers_show_is_told_by_them() -> None:
    observed = felt("left", *HELD)
    observed = replace(observed, slip=replace(observed.slip, state="gross_slip", score=0.4, reason="the rim lags"))
    watch: Any = SimpleNamespace(observe=lambda _frame: observed)
    one = Fingers(watch, watch)
    one._witness = SimpleNamespace(update=lambda _imprints: 0.7)  # type: ignore[assignment]
    assert one.observe(frame("left", 0, 0)).slip.reason == "the rim lags"


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
