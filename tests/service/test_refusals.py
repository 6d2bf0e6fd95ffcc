"""Every refusal to decide, through a whole session: no correction is made from untrustworthy evidence."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import numpy_helper

from service.contract import wire
from service.decision.models import ModelSet, load_models
from service.perception.observation import Observation
from service.session.factory import make_session
from service.session.state_machine import InsertionSession
from tests.service import drawn, tiny_models

ID = "refused"


def models(folder: Path, change: Callable[[onnx.ModelProto], None] | None = None, **card: object) -> ModelSet:
    tiny_models.write_models(folder, **card)
    if change:
        path = folder / "magnitude.step.onnx"
        model = onnx.load(str(path))
        change(model)
        onnx.save(model, str(path))
    return load_models(folder)


def spoil(value: float) -> Callable[[onnx.ModelProto], None]:
    """The magnitude network's error becomes ``value``, whatever its input."""

    def change(model: onnx.ModelProto) -> None:
        for weights in model.graph.initializer:
            if weights.name == "b_error":
                weights.CopyFrom(numpy_helper.from_array(np.full(2, value, np.float32), "b_error"))

    return change


def attempt(session: InsertionSession, frames: int = 30, stop_at: int = 20) -> list:
    session.handle(wire.ClientHello(insertion_id=ID, client="test"), 0)
    arm = wire.Arm(insertion_id=ID, attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0)
    messages = session.handle(arm, 0)
    for index in range(frames):
        pair = drawn.pair(index)
        messages += session.on_pair(pair, pair.captured_ns)
        if index == stop_at:
            stopped = wire.Stopped(insertion_id=ID, attempt=1, depth_mm=6.0, outcome="blocked")
            messages += session.handle(stopped, pair.captured_ns)
    return messages + session.on_tick(drawn.pair(frames - 1).captured_ns + 3_000_000_000)


def refusal(messages: list) -> wire.NoDecision:
    assert not [message for message in messages if isinstance(message, wire.Correction)]
    (refused,) = [message for message in messages if isinstance(message, wire.NoDecision)]
    return refused


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite_decide_nothing(tmp_path: Path, value: float) -> None:
    refused = refusal(attempt(make_session(models(tmp_path, spoil(value)), drawn.calibration())))
    assert refused.reason == "non_finite"


def test_a_class_probability_below_the_cards_threshold_decides_nothing(tmp_path: Path) -> None:
    refused = refusal(attempt(make_session(models(tmp_path, min_confidence=0.999), drawn.calibration())))
    assert (refused.reason, "expected 0.999" in refused.detail) == ("low_confidence", True)


def test_a_finger_that_shows_too_few_markers_decides_nothing(tmp_path: Path) -> None:
    session = make_session(models(tmp_path), drawn.calibration())
    observe = session.right.observe

    def half_blind(frame: object) -> Observation:
        observation = observe(frame)
        few = np.zeros_like(observation.field.valid)
        few[:6] = observation.field.valid[:6]
        blind = observation.seq > 12
        return replace(observation, field=replace(observation.field, valid=few)) if blind else observation

    session.right.observe = half_blind
    refused = refusal(attempt(session))
    assert (refused.reason, "right finger shows" in refused.detail) == ("out_of_distribution", True)


def test_too_few_frames_after_the_onset_decide_nothing(tmp_path: Path) -> None:
    refused = refusal(attempt(make_session(models(tmp_path), drawn.calibration()), frames=15, stop_at=14))
    assert (refused.reason, "expected 8" in refused.detail) == ("too_few_frames", True)


def test_a_refused_attempt_is_followed_by_the_next_one(tmp_path: Path) -> None:
    session = make_session(models(tmp_path, min_confidence=0.999), drawn.calibration())
    attempt(session)
    assert session.decider is not None
    session.decider.grasp.tilt.unknown = ""  # nobody announced the descent, so that its turn would not be known
    arm = wire.Arm(insertion_id=ID, attempt=2, gap_width_mm=56.0, expected_depth_mm=25.0)
    assert session.handle(arm, 5 * 10**9) == []
    assert session.wants_frames
