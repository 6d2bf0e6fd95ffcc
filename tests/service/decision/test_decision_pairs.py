"""Which pairs an attempt's decision rests on, what is read of them, and what is kept."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from service.contract import wire
from service.decision import attempt as under_test
from service.decision.attempt import Attempt, Stage, implausible_width, nothing_held
from service.decision.controllers import Command
from service.decision.evidence import Evidence, Refusal
from service.decision.work import (
    arrays_of,
    correction,
    enough_message,
    latencies,
    plan_work,
    read_by_depth,
)
from service.perception.observation import PairObservation
from tests.service import tiny_models
from tests.service.decision.test_claim import descent, pair

PERIOD_NS = 33_000_000


def at(number: int, late_ns: int = 0) -> PairObservation:
    """The pair with this number; its right frame is a little later than its left one."""
    left, right = pair().fingers
    stamp_ns = number * PERIOD_NS
    return PairObservation(
        replace(left, seq=number, captured_ns=stamp_ns), replace(right, seq=number, captured_ns=stamp_ns + late_ns)
    )


def moving(pairs_n: int, onset: int | None, late_ns: int = 0) -> Attempt:
    attempt = descent(reference=at(100), onset_ns=None if onset is None else onset * PERIOD_NS + late_ns)
    attempt.ring.clear()
    attempt.ring.extend(at(number, late_ns) for number in range(pairs_n))
    return attempt


@pytest.mark.parametrize("late_ns", [0, 5_000_000])
@pytest.mark.parametrize("onset", [3, 0])
def test_a_decision_rests_on_pairs_from_the_onset_on_and_its_reference_is_the_first(late_ns: int, onset: int) -> None:
    """A pair shows the onset once its later frame does."""
    attempt = moving(6, onset, late_ns)
    fresh = attempt.take_decision_pairs(8)
    assert [one.seq for one in fresh] == list(range(onset, 6))
    assert attempt.network_reference is not None
    assert attempt.network_reference.seq == onset
    for number in range(6, 14):
        attempt.ring.append(at(number, late_ns))
        fresh = attempt.take_decision_pairs(8)
        assert [one.seq for one in fresh] == ([number] if number < onset + 8 else [])
    assert [one.seq for one in attempt.decision_pairs] == list(range(onset, onset + 8))


@pytest.mark.parametrize("onset", [None, 9])
def test_before_an_onset_or_a_pair_after_it_nothing_is_taken(onset: int | None) -> None:
    attempt = moving(6, onset)
    assert attempt.take_decision_pairs(8) == []
    assert attempt.take_steps(tiny_models.card("direction", "step")) == []
    assert (attempt.network_reference, attempt.descent, attempt.decision_pairs) == (None, None, [])


class Depth:
    """Stands in for a descent: each pair completes one step."""

    conditions: dict[str, float | None] = {"gap_width_mm": 56.0, "grip_n": None}  # noqa: RUF012 never changed
    problem: Refusal | None = None
    enough = felt = False
    pressed_mm = 0.8

    def __init__(self, *_: Any) -> None:
        self.begun: list[int] = []

    def begin(self, pairs: list[PairObservation], first: int) -> list[Any]:
        self.begun = [pairs[first].seq, len(pairs)]
        return [np.full((2, 1, 1, 3), one.seq, np.float32) for one in pairs[first:]]

    def add(self, both: PairObservation) -> list[Any]:
        return [np.full((2, 1, 1, 3), both.seq, np.float32)]


def test_steps_of_depth_are_read_from_the_onset_to_the_frame_that_stopped_the_arm(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(under_test, "Descent", Depth)
    attempt, card = moving(6, 3), tiny_models.card("direction", "step")
    assert len(attempt.take_steps(card)) == 3
    assert attempt.descent is not None
    assert attempt.descent.begun == [3, 6]  # type: ignore[attr-defined]
    attempt.stop_ns = 7 * PERIOD_NS
    for number in (6, 7, 8):
        attempt.ring.append(at(number))
        attempt.take_steps(card)
    assert [one.seq for one in attempt.decision_pairs] == [3, 4, 5, 6, 7]
    assert [float(step.flat[0]) for step in attempt.steps] == [3.0, 4.0, 5.0, 6.0, 7.0]
    kept = read_by_depth(attempt)
    assert kept["steps"].shape == (5, 2, 1, 1, 3)
    assert kept["conditions"].tolist()[0] == 56.0
    assert set(kept["conditions"].tolist()[1:]) == {0.0}, "what is not known is kept as nothing"


def test_what_is_kept_of_a_decision_is_its_pairs_and_the_markers_of_the_last_one() -> None:
    pairs = [at(4), at(5)]
    moved = replace(pairs[1].left.field, displacement_px=pairs[1].left.field.displacement_px + 2.0)
    pairs[1] = replace(pairs[1], left=replace(pairs[1].left, field=moved))
    arrays = arrays_of(descent(decision_pairs=pairs, network_reference=at(3)))
    assert arrays["frame_seq"].tolist() == [4, 5]
    assert arrays["captured_ns"].tolist() == [4 * PERIOD_NS, 5 * PERIOD_NS]
    assert (arrays["displacement_px"][0] == 2.0).all()
    assert (arrays["displacement_px"][1] == 0.0).all()
    assert arrays["valid"].all()


@pytest.mark.parametrize(("width_mm", "held"), [(None, True), (2.0, True), (1.99, False), (0.0, False)])
def test_fingers_two_millimetres_apart_may_hold_something(width_mm: float | None, held: bool) -> None:
    arm = wire.Arm(insertion_id="one", attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0, gripper_width_mm=width_mm)
    assert (implausible_width(arm) == "") == held


@pytest.mark.parametrize(
    ("left", "right", "held"), [(1.0, 1.0, True), (0.99, 1.5, False), (None, 1.5, False), (None, None, False)]
)
def test_an_object_that_only_its_weight_shows_weighs_on_both_gels(left: Any, right: Any, held: bool) -> None:
    both = pair(left=0.5, right=0.5)
    both = PairObservation(replace(both.left, weight=left), replace(both.right, weight=right))
    assert (nothing_held(both) == "") == held


class Run:
    """Stands in for the networks; keeps what they are shown."""

    step_ms = 2.0

    def __init__(self, fails: Exception | None = None) -> None:
        self.shown: list[Any] = []
        self.fails = fails

    def step(self, frame: Any) -> None:
        if self.fails:
            raise self.fails
        self.shown.append(frame)

    def evidence(self) -> Evidence:
        return Evidence(tiny_models.CLASSES, np.full(9, 1 / 9), (1.0, 1.0))


@pytest.mark.parametrize("fault", [Refusal("out_of_distribution", "strange"), RuntimeError("broken")])
def test_networks_that_fail_are_a_refusal_of_this_attempt(fault: Exception) -> None:
    models: Any = SimpleNamespace(card=tiny_models.card("direction", "step", frames_per_decision=1))
    attempt = descent(decision_pairs=[at(1)], run=Run(fault), generation=4)
    result = plan_work(models, attempt, attempt.decision_pairs[0]).run()
    assert result is not None
    assert (result.generation, result.evidence) == (4, None)
    assert result.refusal is not None
    expected = ("out_of_distribution", "strange"), ("non_finite", "the networks failed: broken")
    assert (result.refusal.reason, str(result.refusal)) in expected


def test_a_stage_that_only_one_finger_went_through_took_as_long_as_there() -> None:
    both = pair()
    once = PairObservation(replace(both.left, cost_ms={"slip": 1.5}), replace(both.right, cost_ms={}))
    run: Any = SimpleNamespace(step_ms=4.0)
    assert latencies(run, once) == {"slip": 1.5, "networks_last_step": 4.0}
    assert latencies(run, PairObservation(replace(both.left, cost_ms={"slip": 0.0}), both.right))["slip"] == 0.0


def test_a_correction_is_no_surer_than_certain_and_tells_the_turn_of_its_newest_pair() -> None:
    sure: Any = SimpleNamespace(
        confidence=1.0 + 1e-9, class_probabilities=dict, estimate=lambda: wire.Estimate(dx_mm=1.0, dtheta_deg=1.0)
    )
    attempt = descent()
    attempt.ring.clear()
    attempt.ring.extend([at(1), pair(turn_rad=math.nan), pair(turn_rad=0.01)])
    message = correction(attempt, sure, Command(1.0, 2.0, "belief", "why"), {})
    assert message.confidence == 1.0
    assert message.turns_deg == pytest.approx((math.degrees(0.01), -math.degrees(0.01)))
    attempt.ring.append(pair(turn_rad=math.nan))
    assert correction(attempt, sure, Command(1.0, 2.0, "belief", "why"), {}).turns_deg is None


def test_the_order_to_stop_names_the_newest_pair_and_its_capture_is_the_last_that_is_read() -> None:
    attempt = moving(4, 1)
    attempt.stage, attempt.descent = Stage.ARMED, Depth()  # type: ignore[assignment]
    assert [*enough_message(attempt)] == []
    attempt.descent.enough = True  # type: ignore[misc, union-attr]
    attempt.stage = Stage.STOPPED
    assert [*enough_message(attempt)] == [], "the arm stands"
    attempt.stage = Stage.ARMED
    (message,) = enough_message(attempt)
    assert (message.frame_seq, message.pressed_mm, attempt.stop_ns) == (3, 0.8, 3 * PERIOD_NS)
    assert [*enough_message(attempt)] == []
