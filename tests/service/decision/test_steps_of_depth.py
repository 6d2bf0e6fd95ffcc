"""Networks that read depth, in the service: it stops the arm when they have seen enough, and refuses by name."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest

from robot_client.insertion.state import State
from service.contract import FramePair, wire
from service.contract.model_card import Pressing, Span
from service.decision import network_input
from service.decision.attempt import Attempt
from service.decision.evidence import Refusal
from service.decision.models import ModelSet, load_models
from service.decision.work import decide_again
from service.perception.pressing import Legs
from simulation.closed_loop.job import Job
from simulation.closed_loop.play import Insertion, stage

RELEASED = Path(__file__).parents[3] / "models" / "pressing" / "pair.step.onnx"
Messages = list[wire.ServiceMessage]


class AnsweredError(Exception):
    """The first attempt has its answer."""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., ModelSet]:
    """The released network with a card reduced to a test's statements and the required ones."""
    released = load_models(RELEASED.parent).steps[0].card
    usual = released.pressing.model_dump(include={"lattice", "step_mm", "steps_n"}) | {"trained": {}}

    def make(**stated: object) -> ModelSet:
        folder = tmp_path_factory.mktemp("stated")
        card = released.model_copy(update={"pressing": Pressing.model_validate(usual | stated)})
        model = onnx.load(str(RELEASED))
        del model.metadata_props[:]
        onnx.helper.set_model_props(model, card.to_props())
        onnx.save(model, str(folder / RELEASED.name))
        return load_models(folder)

    return make


def first_attempt(
    models: ModelSet,
    *,
    given_reach: bool = False,
    until_slip: bool = False,
    press_mm: float = wire.PRESS_MM,
    **changes: float,
) -> tuple[Insertion, Messages]:
    """An insertion that is blocked at first, played until its first answer, and all messages of the service."""
    soft = {"gel.friction": 1.0, "gel.shear_modulus_n_per_mm2": 0.08}
    job = Job("rectangle", 0, 9.0, 4.0, 3, "belief", "fields", "", soft | changes, given_reach=given_reach)
    insertion, replies = stage(job, models), Messages()
    plan = insertion.state.plan
    asked = {"purpose": "probe", "until_slip": True} if until_slip else {}
    pace = plan.pace.model_copy(update={"press_mm": press_mm})
    insertion.state = State(plan.model_copy(update={"pace": pace, **asked}))
    hear = insertion._hear

    def listen(messages: Messages) -> None:
        replies.extend(messages)
        hear(messages)
        if answers(replies)[-1:] and answers(replies)[-1] in ("correction", "no_decision"):
            raise AnsweredError

    insertion._hear = listen  # type: ignore[method-assign]
    with pytest.raises(AnsweredError):
        insertion.run()
    return insertion, replies


def answers(replies: Messages) -> list[str]:
    return [message.type for message in replies if message.type in ("slip", "enough", "correction", "no_decision")]


@pytest.mark.parametrize("fps", [30, 60])
def test_the_arm_is_stopped_once_the_networks_have_seen_enough(made: Callable[..., ModelSet], fps: int) -> None:
    models = made()
    _, replies = first_attempt(models, **{"camera.fps": fps})
    assert answers(replies)[:2] == ["enough", "correction"]
    enough = next(message for message in replies if isinstance(message, wire.Enough))
    decided = next(message for message in replies if isinstance(message, wire.Correction))
    assert all(0.0 <= ms < 10_000.0 for ms in decided.latency_ms.values()), decided.latency_ms
    spacing_mm = 10.0 / fps
    assert wire.PRESS_MM <= enough.pressed_mm < wire.PRESS_MM + spacing_mm


def test_a_press_until_slip_goes_on_after_what_the_networks_read(made: Callable[..., ModelSet]) -> None:
    models = made()
    _, usual = first_attempt(models, press_mm=1.2)
    insertion, replies = first_attempt(models, until_slip=True)
    attempt, read_n = insertion.session.attempt, models.card.pressing.steps_n
    assert answers(replies)[0] == "slip"
    (slip,) = [message for message in replies if isinstance(message, wire.Slip)]
    assert slip.pressed_mm == attempt.descent.pressed_at_mm(slip.captured_ns)
    assert models.card.pressing.depth_mm < slip.pressed_mm < attempt.descent.pressed_mm + 0.5
    assert read_n < len(attempt.steps) < network_input.UNTIL_SLIP_N
    assert attempt.descent.pressed_mm > models.card.pressing.depth_mm
    decided = next(one for one in replies if isinstance(one, wire.Correction))
    as_deep = next(one for one in usual if isinstance(one, wire.Correction))
    assert decided.estimate == as_deep.estimate


@pytest.mark.parametrize("later", ["left", "right"])
def test_the_pair_that_shows_the_slip_is_read_whichever_camera_is_the_later_one(made, monkeypatch, later: str) -> None:
    show = Insertion._show

    def skewed(insertion: Insertion, pair: FramePair, now_ns: int) -> None:
        early = {
            name: replace(one, captured_ns=one.captured_ns - 5_000_000)
            for name, one in (("left", pair.left), ("right", pair.right))
        }
        show(insertion, replace(pair, **{name: one for name, one in early.items() if name != later}), now_ns)

    monkeypatch.setattr(Insertion, "_show", skewed)
    insertion, replies = first_attempt(made(), until_slip=True)
    (slip,) = [message for message in replies if isinstance(message, wire.Slip)]
    assert insertion.session.attempt.decision_pairs[-1].seq == slip.frame_seq


def test_a_press_until_slip_ends_where_nothing_slips(made: Callable[..., ModelSet]) -> None:
    _, replies = first_attempt(made(), until_slip=True, **{"gel.friction": 2.0, "grasp.force_n": 40.0})
    enough = next(message for message in replies if isinstance(message, wire.Enough))
    assert enough.pressed_mm < network_input.UNTIL_SLIP_N * 0.15 + 10.0 / 30.0


def test_what_moves_the_markers_too_little_for_a_press_stops_nothing(
    made: Callable[..., ModelSet], monkeypatch
) -> None:
    """As when a heavy object sags in the air: the onset is awaited again, until slip stops the arm."""
    monkeypatch.setattr(network_input, "shows_press", lambda *_: False)
    _, replies = first_attempt(made())
    assert answers(replies)[0] == "slip"


def test_a_press_that_was_none_is_followed_by_the_next_one(made: Callable[..., ModelSet], monkeypatch) -> None:
    """The markers' motion counts from the dismissed onset on, and the object's whole press is read again."""
    shows_press, awaits, dismissed = network_input.shows_press, Attempt._await_onset, []
    monkeypatch.setattr(network_input, "shows_press", lambda *_: False)

    def sags_once(attempt: Attempt) -> None:
        newest = attempt.ring[-1]
        awaits(attempt)
        assert list(attempt.ring) == [newest]
        dismissed.append((attempt, newest.captured_ns))
        assert attempt.onset_ns is None
        monkeypatch.setattr(network_input, "shows_press", shows_press)

    monkeypatch.setattr(Attempt, "_await_onset", sags_once)
    _, replies = first_attempt(made())
    assert answers(replies)[:2] == ["enough", "correction"]
    ((attempt, dismissed_ns),) = dismissed
    assert attempt.onset_ns >= dismissed_ns
    assert all(pair.captured_ns >= dismissed_ns for pair in attempt.decision_pairs)
    assert next(message for message in replies if isinstance(message, wire.Enough)).pressed_mm >= wire.PRESS_MM


def test_a_speed_that_nobody_trained_for_is_refused_by_name(made: Callable[..., ModelSet]) -> None:
    _, replies = first_attempt(made(trained={"speed_mm_s": Span(low=20, high=40)}))
    refused = next(message for message in replies if isinstance(message, wire.NoDecision))
    assert refused.reason == "out_of_distribution"
    assert "speed_mm_s is 10" in refused.detail


@pytest.mark.parametrize(
    ("going_mm_s", "reason", "says"),
    [(0.0, "stale", "the arm paused in the press"), (None, "out_of_distribution", "expected `descending` with speed")],
)
def test_a_touch_while_the_arm_paused_is_not_taken_for_a_speed_that_was_not_told(
    made: Callable[..., ModelSet], monkeypatch, going_mm_s: float | None, reason: str, says: str
) -> None:
    monkeypatch.setattr(Legs, "speed_mm_s", lambda *_: going_mm_s)
    _, replies = first_attempt(made())
    refused = next(message for message in replies if isinstance(message, wire.NoDecision))
    assert (refused.reason, says in refused.detail) == (reason, True)


def test_a_gap_that_nobody_trained_for_is_refused_before_the_arm_goes_down(made: Callable[..., ModelSet]) -> None:
    insertion = stage(
        Job("rectangle", 0, 9.0, 4.0, 3, "belief", "fields"), made(trained={"gap_width_mm": Span(low=80, high=120)})
    )
    height_mm = insertion.cell.pose[2]
    outcome = insertion.run()
    assert outcome.reason.startswith("service: refused: untrained: gap_width_mm is 56")
    assert insertion.cell.pose[2] == height_mm


def test_a_strange_field_is_refused_with_its_strangeness(made: Callable[..., ModelSet]) -> None:
    _, replies = first_attempt(made(strangeness_limit=1e-30))
    refused = next(message for message in replies if isinstance(message, wire.NoDecision))
    assert "strangeness" in refused.detail


def test_such_a_network_states_its_step_and_no_other_form(made: Callable[..., ModelSet]) -> None:
    card = made().card
    assert card.pressing is not None
    assert card.input_shape == (card.pressing.lattice.rows, card.pressing.lattice.columns, 3)
    assert card.frames_per_decision == card.pressing.steps_n
    assert card.form == "step"


def test_networks_beside_are_given_the_very_steps_that_those_were_that_decided(made: Callable[..., ModelSet]) -> None:
    decided: list[Attempt] = []

    def stop(attempt: Attempt) -> None:
        decided.append(attempt)
        raise AnsweredError

    insertion = stage(Job("rectangle", 0, 9.0, 4.0, 3, "belief", "fields", "", {}, given_reach=True), made())
    insertion.session.on_attempt = stop
    with pytest.raises(AnsweredError):
        insertion.run()
    (attempt,) = decided
    again, mine = decide_again(made(strangeness_limit=1e6), attempt), attempt.result.evidence
    assert (again.error, again.sigma) == (mine.error, mine.sigma)
    assert np.array_equal(again.probabilities, mine.probabilities)
    assert attempt.run.frames_n == len(attempt.steps)
    for stated in (
        {"strangeness_limit": 1e-30},
        {"trained": {"marker_pitch_mm": Span(low=3.0, high=4.0)}},
        {"trained": {"gap_width_mm": Span(low=80.0, high=120.0)}},
    ):
        with pytest.raises(Refusal) as refused:
            decide_again(made(**stated), attempt)
        assert refused.value.reason == "out_of_distribution"
    attempt.decision_pairs.clear()
    with pytest.raises(Refusal, match="gap_width_mm"):
        decide_again(made(**stated), attempt)
