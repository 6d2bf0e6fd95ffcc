"""How long an answer is waited for, and the times it states; on a clock that the test sets."""

import itertools
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from service.contract import wire
from service.decision.controllers import make_controller
from service.decision.evidence import Evidence, Refusal
from service.perception.observation import PairObservation
from service.session.decider import Decider
from service.settings import Deadlines
from tests.service import tiny_models
from tests.service.decision.test_claim import FRAMES, PERIOD_NS, descent, pair
from tests.service.decision.toy_loop import LIMITS

STOPPED_NS = FRAMES * PERIOD_NS
MS = 1_000_000


def decider() -> Decider:
    card = tiny_models.card("direction", "step")
    models: Any = SimpleNamespace(card=card, steps=[SimpleNamespace(card=card)])
    return Decider("one", models, make_controller("heuristic", LIMITS), Deadlines(), consistency=None)


@pytest.mark.parametrize(("waited_ms", "doubted"), [(0, None), (2000, None), (2001, ["not_seen"])])
def test_a_claim_waits_as_long_for_its_last_pair_as_a_decision_for_its_frames(
    waited_ms: int, doubted: list[str] | None
) -> None:
    blind = descent(pushes=[])
    doubts = decider().doubts(blind, STOPPED_NS + waited_ms * MS, 500.0)
    assert (doubts and [doubt.reason for doubt in doubts]) == doubted


@pytest.mark.parametrize(("age_ms", "waits"), [(499, False), (501, True)])
def test_a_claim_rests_on_a_pair_no_older_than_is_allowed(age_ms: int, waits: bool) -> None:
    attempt = descent()
    one = decider()
    one.grasp.width_mm = 50.0
    newest_ns = attempt.pushes[-1].captured_ns
    assert one.doubts(attempt, newest_ns + age_ms * MS, 500.0) == (None if waits else ())


def evidence() -> Evidence:
    probabilities = np.full(9, 0.01)
    probabilities[1] = 0.92
    return Evidence(tiny_models.CLASSES, probabilities, (4.0, 0.0), (1.0, 1.0))


def test_a_correction_states_what_the_controller_and_the_way_since_the_last_frame_took(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = itertools.count(1.0, 0.25)
    monkeypatch.setattr("service.session.decider.time", SimpleNamespace(perf_counter=lambda: next(clock)))
    last = PairObservation(*(replace(finger, captured_ns=10_000_000) for finger in pair().fingers))
    attempt = descent(outcome="blocked", decision_pairs=[pair(), last])
    attempt.result = SimpleNamespace(evidence=evidence(), refusal=None, latency_ms={"networks_last_step": 3.0})
    one = decider()
    correction = one.conclude(attempt, 57_500_000)
    assert isinstance(correction, wire.Correction)
    assert correction.latency_ms == {"networks_last_step": 3.0, "controller": 250.0, "since_last_frame": 47.5}
    assert one.command is not None
    assert (one.command.dx_mm, one.command.dtheta_deg) == (correction.dx_mm, correction.dtheta_deg)


@pytest.mark.parametrize(("waited_ms", "reason"), [(0, None), (2000, None), (2001, "no_motion")])
def test_a_decision_is_waited_for_from_the_stop_on(waited_ms: int, reason: str | None) -> None:
    answer = decider().conclude(descent(outcome="blocked"), STOPPED_NS + waited_ms * MS)
    assert (answer and answer.reason) == reason


def test_a_correction_is_compared_with_the_turn_that_the_newest_pair_shows() -> None:
    compared = list[PairObservation]()
    one = decider()
    one.consistency = SimpleNamespace(add=lambda _decided, pair: compared.append(pair))
    attempt = descent(outcome="blocked", decision_pairs=[pair()])
    attempt.ring.extend([pair(), pair(turn_rad=0.01)])
    attempt.result = SimpleNamespace(evidence=evidence(), refusal=None, latency_ms={})
    one.conclude(attempt, STOPPED_NS)
    assert compared == [attempt.ring[-1]]


def test_what_contradicts_earlier_corrections_moves_nothing() -> None:
    def contradicted(_decided: object, _pair: object) -> None:
        raise Refusal("out_of_distribution", "the arm moves the wrong way")

    one = decider()
    one.consistency = SimpleNamespace(add=contradicted)
    attempt = descent(outcome="blocked", decision_pairs=[pair()])
    attempt.result = SimpleNamespace(evidence=evidence(), refusal=None, latency_ms={})
    answer = one.conclude(attempt, STOPPED_NS)
    assert (answer.type, answer.detail, one.command) == ("no_decision", "the arm moves the wrong way", None)
