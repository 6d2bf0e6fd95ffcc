"""From `arm` to the reference, and what counts as watched; on made-up observations."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from service.contract import Finger, TactileFrame, wire
from service.decision.attempt import Attempt, Stage
from service.perception.markers.field import TrackStatus, empty_field
from service.perception.observation import Observation, PairObservation
from tests.service.decision.test_claim import observation

ARMED_NS = 1000
PIXELS = np.zeros((2, 2, 3), np.uint8)


def arming(**stated: Any) -> Attempt:
    arm = wire.Arm(insertion_id="one", attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0, **stated)
    return Attempt(arm, ARMED_NS, generation=1)


def frame(finger: Finger, captured_ns: int) -> TactileFrame:
    return TactileFrame(finger, captured_ns, captured_ns, PIXELS)


def at(finger: Finger, captured_ns: int, **changes: Any) -> Observation:
    return replace(observation(finger), captured_ns=captured_ns, seq=captured_ns, **changes)


def both(left_ns: int, right_ns: int, **changes: Any) -> PairObservation:
    return PairObservation(at("left", left_ns, **changes), at("right", right_ns, **changes))


def rearmed(attempt: Attempt, *frames: TactileFrame) -> list[int]:
    """The frames that became the reference of a finger's slip."""
    captured = list[int]()
    for one in frames:
        watch: Any = SimpleNamespace(rearm=lambda one=one: captured.append(one.captured_ns))
        attempt.rearm(watch, one)
    return captured


def ready(**stated: Any) -> Attempt:
    attempt = arming(**stated)
    rearmed(attempt, frame("left", ARMED_NS), frame("right", ARMED_NS))
    return attempt


def test_slip_is_counted_from_the_first_frame_of_each_finger_that_was_captured_after_arm() -> None:
    attempt = arming()
    frames = [frame("left", 999), frame("left", 1000), frame("left", 1001), frame("right", 998), frame("right", 1003)]
    assert rearmed(attempt, *frames) == [1000, 1003]
    attempt.stage = Stage.ARMED
    attempt.rearmed.clear()
    assert rearmed(attempt, frame("left", 1010)) == [], "an armed attempt keeps its reference"


def test_an_attempt_is_armed_with_a_pair_of_two_rearmed_fingers_dated_by_the_older_one() -> None:
    attempt = arming()
    rearmed(attempt, frame("left", 1000))
    assert attempt.take_reference(both(1000, 1002)) is None
    assert attempt.stage is Stage.ARMING
    rearmed(attempt, frame("right", 1002))
    armed = attempt.take_reference(both(1000, 1002))
    assert isinstance(armed, wire.Armed)
    assert (armed.reference_seq, armed.frame_captured_ns, attempt.stage) == (1000, 1000, Stage.ARMED)
    assert [pair.captured_ns for pair in attempt.ring] == [1002]


def test_a_frame_that_cannot_be_read_is_no_reference_and_slip_is_counted_anew_from_a_later_one() -> None:
    attempt, dark = ready(), at("left", 1000)
    attempt.unread(replace(dark, field=replace(dark.field, status="no_grid", reason="")))
    attempt.unread(at("right", 1000))
    assert attempt.problem == "left: no_grid"
    both_dark = ready()
    for finger in ("left", "right", "left"):
        both_dark.unread(replace(at(finger, 1000), field=replace(dark.field, status="no_grid", reason="")))
    assert both_dark.problem == "right: no_grid; left: no_grid"
    assert attempt.take_reference(both(1005, 1000)) is None, "left has no reference"
    assert rearmed(attempt, frame("left", 1010), frame("right", 1010)) == [1010]
    assert isinstance(attempt.take_reference(both(1010, 1010)), wire.Armed)


def test_fingers_with_different_grids_are_not_armed_and_both_are_tried_anew() -> None:
    attempt, pair = ready(), both(1000, 1000)
    other = replace(pair.right, field=empty_field(1000, "ok", ""))
    assert attempt.take_reference(replace(pair, right=other)) is None
    assert attempt.problem.startswith("the fingers show different grids: left 21 x 20 markers, right ")
    assert rearmed(attempt, frame("left", 1010), frame("right", 1010)) == [1010, 1010]


@pytest.mark.parametrize(
    ("stated", "shown", "reason"),
    [
        ({}, {"bulge": 0.9}, "nothing_held"),
        ({}, {"bulge": 0.9, "weight": 0.9}, "nothing_held"),
        ({}, {"bulge": 0.9, "weight": 1.1}, None),
        ({}, {"bulge": 0.9, "touch": 1.1}, None),
        ({}, {"bulge": None}, None),
        ({"gripper_width_mm": 1.9}, {}, "implausible_width"),
    ],
)
def test_a_hand_that_holds_nothing_is_not_armed_and_its_attempt_is_over(
    stated: dict[str, Any], shown: dict[str, Any], reason: str | None
) -> None:
    attempt = ready(**stated)
    answer = attempt.take_reference(both(1000, 1000, **shown))
    assert getattr(answer, "reason", None) == reason
    assert attempt.stage is (Stage.ARMED if reason is None else Stage.DECIDED)


def armed() -> Attempt:
    attempt = ready()
    attempt.take_reference(both(1000, 1000))
    return attempt


def watched(attempt: Attempt, *shown: Observation) -> list[tuple[int, int]]:
    """The stamps and the times of judgement in answer to these observations, judged 7 ns after their capture."""
    answers = [answer for one in shown for answer in attempt.watching(one, one.captured_ns + 7)]
    return [(answer.frame_captured_ns, answer.judged_ns) for answer in answers]


def test_one_finger_and_frames_that_say_nothing_are_not_watching() -> None:
    attempt = armed()
    assert watched(attempt, at("left", 1010), at("left", 1020)) == []
    dark = at("right", 1030)
    dark = replace(dark, slip=replace(dark.slip, state="unknown"))
    assert watched(attempt, dark) == []
    assert watched(attempt, at("right", 1000)) == [], "no newer than the reference"
    assert watched(attempt, at("right", 1040)) == [(1020, 1047)]


def test_a_frame_that_may_be_a_copy_is_watched_no_later_than_the_one_before() -> None:
    attempt = armed()
    assert watched(attempt, at("left", 1010), at("right", 1010)) == [(1010, 1017)]
    doubted = replace(at("left", 1020), certain_ns=1010)
    assert watched(attempt, at("right", 1020), doubted) == []
    assert watched(attempt, at("left", 1030)) == [(1020, 1037)]


@pytest.mark.parametrize("spoilt", [{"slip_sent": True}, {"stale_sent": True}, {"broken": "left gone"}])
def test_an_attempt_whose_reference_is_spoilt_is_not_watched(spoilt: dict[str, Any]) -> None:
    attempt = armed()
    for name, value in spoilt.items():
        setattr(attempt, name, value)
    assert watched(attempt, at("left", 1010), at("right", 1010)) == []


@pytest.mark.parametrize(("left_ns", "right_ns", "onset_ns"), [(None, None, None), (5, None, 5), (7, 6, 6)])
def test_motion_began_when_the_first_finger_saw_it_and_stays_at_that(
    left_ns: int | None, right_ns: int | None, onset_ns: int | None
) -> None:
    attempt, pair = armed(), both(1010, 1010)
    shown = PairObservation(replace(pair.left, onset_ns=left_ns), replace(pair.right, onset_ns=right_ns))
    attempt.take_in(shown)
    assert attempt.onset_ns == onset_ns
    assert (len(attempt.pushes), len(attempt.ring)) == (1, 2)
    attempt.take_in(both(1020, 1020, onset_ns=1))
    assert attempt.onset_ns == (onset_ns or 1)


def carried(captured_ns: int, by_px: float, status: TrackStatus = "tracking") -> PairObservation:
    """A pair in which the object has carried all markers that far."""
    pair = both(captured_ns, captured_ns)
    field = replace(pair.left.field, captured_ns=captured_ns, status=status)
    field = replace(field, displacement_px=field.displacement_px + np.float32(by_px))
    return PairObservation(replace(pair.left, field=field), replace(pair.right, field=field))


@pytest.mark.parametrize("status", ["tracking", "lost", "ambiguous", "duplicate"])
def test_after_a_sag_the_press_is_noticed_though_the_pair_before_the_descent_could_not_be_read(
    status: TrackStatus,
) -> None:
    attempt = armed()
    sags = carried(1010, 2.0)
    attempt.take_in(PairObservation(replace(sags.left, onset_ns=1010), sags.right))
    attempt.take_in(carried(1020, 2.0, status))
    attempt.descends(wire.Descending(insertion_id="one", attempt=1, speed_mm_s=10.0), 1025)
    for captured_ns, by_px in ((1030, 2.0), (1040, 2.0), (1050, 4.0)):
        assert attempt.onset_ns is None
        attempt.take_in(carried(captured_ns, by_px))
    assert attempt.onset_ns == 1050
