"""When an attempt is answered and how, on a clock of the test's own."""

import itertools
import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from service.contract import wire
from service.decision.attempt import Attempt, Stage, WorkResult
from service.decision.consistency import Consistency
from service.decision.controllers import Belief, Heuristic
from service.decision.evidence import Evidence, Refusal
from service.decision.seating import Push
from service.perception.observation import PairObservation
from service.session.decider import Decider
from service.settings import Deadlines
from tests.service import tiny_models
from tests.service.decision.test_claim import descent, pair

LIMITS = wire.Limits(max_dx_mm=15.0, max_dtheta_deg=15.0, max_frame_age_ms=500.0)
STOPPED_NS = 50_000_000_000
MS, S = 1_000_000, 1_000_000_000
SURE = np.array([0.92 if entry.name == "5" else 0.01 for entry in tiny_models.CLASSES])
EVIDENCE = Evidence(tiny_models.CLASSES, SURE, (6.0, 8.0), (1.0, 1.5))


def decider(**changes: Any) -> Decider:
    card = tiny_models.card("direction", "step")
    models: Any = SimpleNamespace(card=card, steps=[SimpleNamespace(card=card)])
    return Decider(
        **{"insertion_id": "one", "models": models, "controller": Heuristic(LIMITS)} | changes, deadlines=Deadlines()
    )


def pair_at(captured_ns: int) -> PairObservation:
    both = pair()
    return PairObservation(replace(both.left, captured_ns=captured_ns), replace(both.right, captured_ns=captured_ns))


def blocked(evidence: Evidence | None = EVIDENCE, refusal: Refusal | None = None, **changes: Any) -> Attempt:
    """An attempt that stopped at `STOPPED_NS`, its networks' answer, and its pairs, the newest 12.5 ms before."""
    result = WorkResult("one", 1, evidence, refusal, {"networks_last_step": 3.0})
    pairs = [pair_at(STOPPED_NS - age_ns) for age_ns in (90 * MS, 50 * MS, 12_500_000)]
    usual = {"outcome": "blocked", "stopped_ns": STOPPED_NS, "result": result, "decision_pairs": pairs}
    return descent(**usual | changes)


def full_depth(newest_ns: int, **changes: Any) -> Attempt:
    """An attempt at full depth, to which the newest pair that shows the gels' load is so new."""
    pushes = [Push(newest_ns - back * 33 * MS, 0.0, 0.0) for back in range(60, -1, -1)]
    began_ns = newest_ns - 2 * S
    return descent(pushes=pushes, descending_ns=began_ns, stopped_ns=STOPPED_NS, **changes)


@pytest.mark.parametrize(
    ("after_stop_ms", "age_ms", "new_enough"),
    [(-1, 149, True), (-1, 151, False), (0, 149, True), (0, 151, True), (0, 499, True), (0, 501, False)],
)
def test_full_depth_is_judged_by_a_pair_no_older_than_150_ms_or_500_ms_since_the_arm_stands(
    after_stop_ms: int, age_ms: int, new_enough: bool
) -> None:
    one, newest_ns = decider(), STOPPED_NS + after_stop_ms * MS
    one.grasp.width_mm = 50.0
    attempt = full_depth(newest_ns, reported_ns=STOPPED_NS)
    assert one.doubts(attempt, newest_ns + age_ms * MS) == (() if new_enough else None)


def test_a_client_that_overstates_how_long_the_arm_stands_makes_no_older_pair_fresh() -> None:
    one, reported_ns = decider(), STOPPED_NS + 600 * MS
    one.grasp.width_mm = 50.0
    attempt = full_depth(reported_ns - 400 * MS, reported_ns=reported_ns)
    assert one.doubts(attempt, reported_ns) is None


def test_full_depth_that_nobody_saw_is_doubted_two_seconds_after_the_arm_stood_and_not_before() -> None:
    one, attempt = decider(), full_depth(STOPPED_NS - 3 * S)
    assert one.doubts(attempt, STOPPED_NS + 1999 * MS) is None
    (doubt,) = one.doubts(attempt, STOPPED_NS + 2001 * MS) or ()
    assert (doubt.reason, doubt.detail) == ("not_seen", "no pair showed within 2.0 s what the gels carry at full depth")


def test_an_answer_says_how_long_it_took_in_milliseconds_and_how_old_its_newest_pair_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ticks_s = itertools.count(100.0, 0.004)
    monkeypatch.setattr("service.session.decider.time.perf_counter", lambda: next(ticks_s))
    one = decider()
    answer = one.conclude(blocked(), STOPPED_NS + 30 * MS)
    assert isinstance(answer, wire.Correction)
    assert answer.latency_ms == pytest.approx({"networks_last_step": 3.0, "controller": 4.0, "since_last_frame": 42.5})
    assert one.command is not None
    assert (
        (answer.dx_mm, answer.dtheta_deg) == (one.command.dx_mm, one.command.dtheta_deg) == pytest.approx((-4.2, -5.6))
    )


def test_an_attempt_is_answered_once_it_stands_and_its_networks_have_answered() -> None:
    for attempt in (blocked(stage=Stage.ARMED, stopped_ns=None), blocked(result=None, fed=True)):
        one = decider()
        assert one.conclude(attempt, STOPPED_NS + 9999 * MS) is None
        assert (one.command, one.grasp.pressed_mm) == (None, 0.0)
        assert math.isfinite(one.grasp.tilt.deg), "an attempt without an answer has left nothing behind yet"


@pytest.mark.parametrize(
    ("attempt", "reason", "detail"),
    [
        (blocked(broken="left is gone"), "stale", "a camera failed during the attempt: left is gone"),
        (
            blocked(stale_sent=True, result=None),
            "stale",
            "the frames grew too old during the attempt, so the depth of its pictures is not known",
        ),
        (
            blocked(outcome="stopped"),
            "stale",
            "the arm stopped for another reason than slip or enough, so the depth of its pictures is not known",
        ),
        (blocked(None, Refusal("no_motion", "nothing moved")), "no_motion", "nothing moved"),
        (blocked(None, None), "non_finite", "no evidence"),
        (blocked(result=None, fed=True), "stale", "the networks took longer than 10 s"),
    ],
)
def test_an_attempt_that_cannot_be_trusted_is_answered_with_the_reason_and_moves_nothing(
    attempt: Attempt, reason: str, detail: str
) -> None:
    one = decider()
    one.conclude(blocked(), STOPPED_NS + MS)
    answer = one.conclude(attempt, STOPPED_NS + 10_001 * MS)
    assert isinstance(answer, wire.NoDecision)
    assert (answer.insertion_id, answer.attempt, answer.reason, answer.detail) == ("one", 1, reason, detail)
    assert one.command is None, "the last move is none of this attempt's"


def test_evidence_that_is_less_sure_than_the_card_asks_for_moves_nothing() -> None:
    card = tiny_models.card("direction", "step", min_confidence=0.999)
    models: Any = SimpleNamespace(card=card, steps=[SimpleNamespace(card=card)])
    answer = decider(models=models).conclude(blocked(), STOPPED_NS + MS)
    assert isinstance(answer, wire.NoDecision)
    assert answer.reason == "low_confidence"


def test_answered_attempts_are_what_the_next_claim_is_checked_against() -> None:
    one = decider()
    attempt = blocked(onset_ns=STOPPED_NS - S // 2, descending_ns=STOPPED_NS - 2 * S, depth_mm=10.0)
    attempt.pushes.append(Push(STOPPED_NS, 0.3, 0.4))
    one.conclude(attempt, STOPPED_NS + MS)
    assert (one.grasp.pressed_mm, one.grasp.blocked_pitch) == (pytest.approx(2.5), 0.4)
    again = one.afresh("two")
    assert (again.insertion_id, again.command, again.grasp.blocked_pitch) == ("two", None, 0.0)
    assert (again.controller, again.consistency) == (one.controller, one.consistency)


@pytest.mark.parametrize("followed", [True, False])
def test_a_mirrored_picture_is_noticed_in_the_newest_pair_unless_others_move_the_arm(followed: bool) -> None:
    """Both fingers see the object turn to the same side, once in the newest pair and never before it."""
    one = decider(consistency=Consistency() if followed else None)
    attempt = blocked()
    attempt.ring.clear()
    attempt.ring.extend([pair_at(STOPPED_NS - 50 * MS), pair_at(STOPPED_NS - 40 * MS), mirrored()])
    answer = one.conclude(attempt, STOPPED_NS + MS)
    assert answer is not None
    assert answer.type == ("no_decision" if followed else "correction")
    if isinstance(answer, wire.NoDecision):
        assert (answer.reason, one.command) == ("contradictory", None)


def test_an_attempt_that_contradicts_the_others_moves_no_belief() -> None:
    """Only its failure counts: what the fingers felt is not believed, and the arm does not move."""
    one = decider(controller=Belief(LIMITS))
    attempt = blocked()
    attempt.ring.extend([pair_at(STOPPED_NS - 40 * MS), mirrored()])
    answer = one.conclude(attempt, STOPPED_NS + MS)
    assert isinstance(answer, wire.NoDecision)
    assert answer.reason == "contradictory"
    failed = Belief(LIMITS)
    failed.blocked_without_evidence()
    assert isinstance(one.controller, Belief)
    assert one.controller.grid.offset.tolist() == [0.0, 0.0]
    np.testing.assert_array_equal(one.controller.grid.probability, failed.grid.probability)


@pytest.mark.parametrize(
    ("followed", "reason", "answered"),
    [
        (True, "out_of_distribution", "contradictory"),
        (False, "out_of_distribution", "out_of_distribution"),
        (True, "no_motion", "no_motion"),
    ],
)
def test_a_mirrored_picture_is_named_where_its_fields_are_too_strange_to_decide(
    followed: bool, reason: Any, answered: str
) -> None:
    one = decider(consistency=Consistency() if followed else None)
    attempt = blocked(None, Refusal(reason, "strange"))
    attempt.ring.extend([pair_at(STOPPED_NS - 40 * MS), mirrored()])
    answer = one.conclude(attempt, STOPPED_NS + MS)
    assert isinstance(answer, wire.NoDecision)
    assert (answer.reason, answer.turns_deg) == (answered, pytest.approx((3.0, 3.0)))


def mirrored() -> PairObservation:
    fingers = [replace(one, slip=replace(one.slip, angle_rad=math.radians(3.0))) for one in pair_at(STOPPED_NS).fingers]
    return PairObservation(*fingers)


def test_networks_that_were_not_trained_for_this_cell_refuse_before_the_descent() -> None:
    one, arm = decider(), blocked(stage=Stage.ARMING)
    assert one.before_descending(arm) == []
    trained: Any = SimpleNamespace(outside=lambda stated: f"trained on another gap than {stated['gap_width_mm']:g} mm")
    card: Any = SimpleNamespace(pressing=trained)
    one.models = SimpleNamespace(card=card)  # type: ignore[assignment]
    (refused,) = one.before_descending(arm)
    assert (refused.reason, refused.detail) == ("untrained", "trained on another gap than 56 mm")
    assert arm.stage is Stage.DECIDED
    trained.outside = lambda _: ""
    assert one.before_descending(blocked(stage=Stage.ARMING)) == []


@pytest.mark.parametrize(("waited_ms", "reason"), [(0, None), (2000, None), (2001, "no_motion")])
def test_a_decision_is_waited_for_from_the_stop_on(waited_ms: int, reason: str | None) -> None:
    answer = decider().conclude(descent(outcome="blocked", stopped_ns=STOPPED_NS), STOPPED_NS + waited_ms * MS)
    assert (answer and answer.reason) == reason  # type: ignore[union-attr]
