"""Reasons against a decision are an answer, not an error of the networks' thread."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from service.contract import MarkerSpec, wire
from service.decision.attempt import Attempt, Stage
from service.decision.evidence import Evidence, Refusal
from service.decision.work import (
    arrays_of,
    check_evidence,
    decide_again,
    overdue,
    plan_steps,
    plan_work,
    slip_message,
)
from service.perception.markers.field import empty_field
from service.perception.observation import PairObservation
from service.settings import Deadlines
from tests.service import tiny_models
from tests.service.decision.test_claim import descent, pair

EIGHT_FRAMES: Any = SimpleNamespace(frames_per_decision=8, pressing=None)


@pytest.mark.parametrize("referenced", [False, True])
def test_a_grid_that_is_not_the_networks_is_refused_as_any_other_stranger(*, referenced: bool) -> None:
    lattice = MarkerSpec(rows=20, columns=21, pitch_px=15.0, first_px=(13.0, 17.0))
    models = SimpleNamespace(card=tiny_models.card("direction", "step", markers=lattice))
    arm = wire.Arm(insertion_id="one", attempt=3, gap_width_mm=56.0, expected_depth_mm=25.0)
    attempt = Attempt(arm, 0, generation=7)
    finger = SimpleNamespace(field=empty_field(0, "no_grid", "no markers"))
    pair = SimpleNamespace(fingers=(finger, finger))
    attempt.decision_pairs = [pair]
    attempt.network_reference = pair if referenced else None
    result = plan_work(models, attempt, pair).run()
    assert result is not None
    assert (result.insertion_id, result.generation, result.evidence) == ("one", 7, None)
    assert result.refusal is not None
    assert result.refusal.reason == "out_of_distribution"


def test_the_depth_of_a_press_in_which_the_arm_paused_is_not_known() -> None:
    """Before the touch a pause does not matter."""
    models = SimpleNamespace(steps=[SimpleNamespace(card=SimpleNamespace(min_confidence=0.0))])
    evidence = SimpleNamespace(confidence=1.0)
    for onset_ns, known in ((10_000_000, False), (60_000_000, True)):
        attempt = descent(decision_pairs=[pair()], onset_ns=onset_ns)
        attempt.legs.add(0, 10.0)
        attempt.descends(wire.Descending(insertion_id="one", attempt=1, speed_mm_s=10.0, paused_s=0.03), 50_000_000)
        assert attempt.paused_in_press != known
        if known:
            check_evidence(models, attempt, evidence)
        else:
            with pytest.raises(Refusal, match="the arm paused in the press"):
                check_evidence(models, attempt, evidence)
    with pytest.raises(Refusal, match="no pair shows the motion"):
        check_evidence(models, descent(decision_pairs=[]), evidence)


@pytest.mark.parametrize("why", [{"stale_sent": True}, {"outcome": "stopped"}, {"broken": "left is gone"}])
def test_no_version_learns_from_pictures_of_unknown_depth(why: dict[str, Any]) -> None:
    """Those beside the active one have the same steps, and would answer."""
    models = SimpleNamespace(steps=[SimpleNamespace(card=SimpleNamespace(min_confidence=0.0))])
    attempt, evidence = descent(decision_pairs=[pair()], outcome="blocked"), SimpleNamespace(confidence=1.0)
    check_evidence(models, attempt, evidence)
    for name, value in why.items():
        setattr(attempt, name, value)
    with pytest.raises(Refusal) as refused:
        check_evidence(models, attempt, evidence)
    assert refused.value.reason == "stale"


def test_what_moved_before_the_arm_did_is_no_press() -> None:
    attempt = descent(onset_ns=5, descending_ns=None, fed=True)
    attempt.ring.append(pair())
    attempt.descends(wire.Descending(insertion_id="one", attempt=1, speed_mm_s=10.0), 10)
    assert (attempt.onset_ns, attempt.fed, attempt.descending_ns) == (None, False, 10)


def shows(share: float, status: str = "") -> PairObservation:
    """A pair whose left finger shows this share of its markers."""
    both = pair()
    field, seen_n = both.left.field, round(share * both.left.field.valid.size)
    valid = np.arange(field.valid.size).reshape(field.valid.shape) < seen_n
    return replace(both, left=replace(both.left, field=replace(field, valid=valid, status=status or field.status)))


@pytest.mark.parametrize(
    ("share", "status", "confidence", "reason"),
    [
        (0.45, "", 0.9, "out_of_distribution"),
        (0.55, "", 0.9, ""),
        (0.45, "duplicate", 0.9, ""),
        (0.55, "", 0.29, "low_confidence"),
        (0.55, "", 0.31, ""),
    ],
)
def test_evidence_of_half_a_picture_or_of_no_class_moves_nothing(
    share: float, status: str, confidence: float, reason: str
) -> None:
    card = tiny_models.card("direction", "step", min_confidence=0.3)
    models: Any = SimpleNamespace(steps=[SimpleNamespace(card=card)])
    probabilities = np.full(9, (1 - confidence) / 8)
    probabilities[4] = confidence
    attempt = descent(decision_pairs=[shows(share, status)])
    try:
        check_evidence(models, attempt, Evidence(tiny_models.CLASSES, probabilities, (1.0, 1.0)))
        refused = ""
    except Refusal as refusal:
        refused = refusal.reason
    assert refused == reason


@pytest.mark.parametrize(
    ("pairs_n", "fed", "waited_s", "reason"),
    [
        (8, False, 9.9, ""),
        (8, False, 10.1, "stale"),
        (3, True, 9.9, ""),
        (3, True, 10.1, "stale"),
        (3, False, 1.9, ""),
        (3, False, 2.1, "too_few_frames"),
        (7, False, 2.1, "too_few_frames"),
        (0, False, 2.1, "no_motion"),
    ],
)
def test_a_decision_is_overdue_by_what_it_waits_for(pairs_n: int, fed: bool, waited_s: float, reason: str) -> None:
    attempt = descent(decision_pairs=[pair()] * pairs_n, fed=fed)
    refusal = overdue(attempt, waited_s, EIGHT_FRAMES, Deadlines())
    assert (refusal.reason if refusal else "") == reason


@pytest.mark.parametrize(
    ("pairs_n", "fed", "waited_s", "why"),
    [
        (9, False, 1.9, ""),
        (9, False, 2.1, "no pair came after the stop"),
        (9, True, 9.9, ""),
        (9, True, 10.1, "the networks took longer than 10 s"),
        (0, False, 2.1, "nothing touches the gels"),
    ],
)
def test_networks_that_read_depth_wait_for_a_pair_of_the_standstill_however_many_came_before(
    pairs_n: int, fed: bool, waited_s: float, why: str
) -> None:
    card: Any = SimpleNamespace(frames_per_decision=8, pressing=object())
    attempt = descent(decision_pairs=[pair()] * pairs_n, fed=fed)
    assert str(overdue(attempt, waited_s, card, Deadlines()) or "") == why


@pytest.mark.parametrize(
    ("left", "right", "empty"), [("hold", "hold", 0), ("no_contact", "no_contact", 1), ("hold", "no_contact", 0)]
)
def test_why_nothing_moved_is_told_from_why_nothing_is_touched(left: Any, right: Any, empty: int) -> None:
    attempt = descent()
    fingers = [
        replace(one, slip=replace(one.slip, state=state))
        for one, state in zip(pair().fingers, (left, right), strict=True)
    ]
    attempt.ring.append(PairObservation(*fingers))
    why = str(overdue(attempt, 3.0, EIGHT_FRAMES, Deadlines()))
    assert why == ["neither finger saw the object move", "nothing touches the gels"][empty]


def test_a_slip_is_as_old_as_its_frame() -> None:
    shown = replace(pair().left, seq=7, captured_ns=40_000_000)
    slip = slip_message(descent(), shown, 47_500_000)
    assert (slip.frame_seq, slip.captured_ns, slip.age_ms, slip.score) == (7, 40_000_000, 7.5, 0.0)
    assert slip.pressed_mm is None, "no contact is known"


def test_of_an_attempt_that_nothing_moved_in_its_reference_is_kept() -> None:
    attempt = descent()
    assert arrays_of(attempt)["frames"].shape[:2] == (1, 2)
    assert arrays_of(attempt)["frame_seq"].tolist() == [0]
    assert str(arrays_of(attempt)["decision"]) == "{}"
    assert arrays_of(descent(reference=None)) == {}
    moved = [replace(pair(), left=replace(pair().left, seq=seq)) for seq in (4, 5)]
    assert arrays_of(descent(decision_pairs=moved))["frames"].shape[:2] == (2, 2)


def test_an_attempt_in_which_nothing_was_shown_cannot_be_decided_again() -> None:
    models: Any = SimpleNamespace(card=tiny_models.card("direction", "step"))
    with pytest.raises(Refusal, match="no frame pair"):
        decide_again(models, descent(network_reference=None))


def stamped(seq: int, cost_ms: float = 1.0) -> PairObservation:
    """A pair of that number, captured as many hundredths of a second after the first."""
    changed = {"seq": seq, "captured_ns": seq * 10_000_000, "cost_ms": {"markers": cost_ms}}
    return PairObservation(*(replace(one, **changed) for one in pair().fingers))


def test_the_step_on_the_last_pair_alone_returns_the_result() -> None:
    models: Any = SimpleNamespace(card=tiny_models.card("direction", "step", frames_per_decision=3))
    run: Any = SimpleNamespace(step=lambda _: None, step_ms=2.0, evidence=lambda: "felt")
    attempt, pairs = descent(run=run), [stamped(seq) for seq in range(3)]
    returned, fed = list[object](), list[bool]()
    for index, one in enumerate(pairs):
        attempt.decision_pairs = pairs[: index + 1]
        returned.append(plan_work(models, attempt, one).run())
        fed.append(attempt.fed)
    assert [result is not None for result in returned] == fed == [False, False, True]
    assert plan_work(models, attempt, pairs[1]).run() is None, "another pair of a whole decision"


class Steps:
    """A descent whose every pair completes the steps of depth that a test lays out."""

    def __init__(self, *fresh: list[int], **state: Any) -> None:
        self.fresh, self.problem, self.enough, self.felt = [*fresh], None, False, True
        vars(self).update(state)

    def add(self, _pair: PairObservation) -> list[int]:
        return self.fresh.pop(0)


def planned(attempt: Attempt, steps: Any, read: list[int]) -> Any:
    """The result of the newest pair, "nothing to do" or None; ``read`` is what the networks were shown."""
    models: Any = SimpleNamespace(card=SimpleNamespace(pressing=SimpleNamespace(steps_n=5)))
    attempt.run = SimpleNamespace(step=read.append, step_ms=2.0, evidence=lambda: "felt")  # type: ignore[assignment]
    attempt.descent = steps
    works = plan_steps(models, attempt)
    return works[0].run() if works else "nothing to do"


def test_networks_are_shown_as_many_steps_as_they_read_however_long_is_pressed() -> None:
    read, attempt = list[int](), descent(stage=Stage.ARMED)
    steps = Steps([1, 2], [], [3, 4, 5, 6], [7])
    assert [planned(attempt, steps, read) for _ in range(4)] == [None, "nothing to do", None, "nothing to do"]
    assert read == [1, 2, 3, 4, 5]
    assert attempt.steps == [1, 2, 3, 4, 5, 6, 7]


@pytest.mark.parametrize("why", ["enough", "stopped", "slip", "stale", "camera"])
def test_what_ends_a_press_ends_what_the_networks_wait_for(why: str) -> None:
    read, attempt = list[int](), descent(stage=Stage.STOPPED if why == "stopped" else Stage.ARMED)
    attempt.slip_sent, attempt.stale_sent = why == "slip", why == "stale"
    attempt.broken = "left gone" if why == "camera" else ""
    result = planned(attempt, Steps([1], enough=why == "enough"), read)
    assert (result.evidence, result.refusal, read, attempt.fed) == ("felt", None, [1], True)
    assert planned(attempt, Steps([2]), read) == "nothing to do"


def test_a_press_that_cannot_be_read_is_refused_with_its_problem() -> None:
    problem = Refusal("out_of_distribution", "the grid changed")
    result = planned(descent(stage=Stage.ARMED), Steps([], problem=problem), [])
    assert (result.evidence, result.refusal) == (None, problem)


def test_what_was_no_press_is_awaited_again_and_decides_nothing() -> None:
    attempt = descent(stage=Stage.ARMED, onset_ns=5)
    assert planned(attempt, Steps([1], enough=True, felt=False), []) == "nothing to do"
    assert (attempt.onset_ns, attempt.descent, attempt.steps, attempt.fed) == (None, None, [], False)


@pytest.mark.parametrize("problem", [None, Refusal("out_of_distribution", "the grid changed")])
def test_other_networks_refuse_a_press_that_was_not_read(problem: Refusal | None) -> None:
    models: Any = SimpleNamespace(card=SimpleNamespace(pressing=SimpleNamespace(steps_n=5)))
    attempt = descent(descent=problem and Steps(problem=problem))
    with pytest.raises(Refusal) as refused:
        decide_again(models, attempt)
    assert (refused.value.reason == "no_motion") if problem is None else (refused.value is problem)
