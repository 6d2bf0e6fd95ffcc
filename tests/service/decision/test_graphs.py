"""What a graph must take and give to serve, which networks decide together, and what their outputs are taken for."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from service.contract.model_card import CONDITIONS
from service.decision.evidence import DecisionRun, Evidence, Refusal, from_joint, from_pair, softmax
from service.decision.models import LoadedModel, ModelError, ModelSet, _check_graph, _choose_steps
from tests.service import tiny_models

SHAPE = [2, 320, 327, 3]
STEP = {"frame": SHAPE, "reference": SHAPE, "state": [tiny_models.STATE]}
GIVEN = {"direction": {"logits"}, "magnitude": {"error", "log_sigma"}, "joint": {"log_density"}}


class Session:
    """Stands in for onnxruntime: a graph with these inputs and outputs, which answers with ``answer``."""

    def __init__(self, inputs: dict[str, list[int]], outputs: set[str], answer: Any = None) -> None:
        self.inputs, self.outputs, self.answer, self.fed = inputs, outputs, answer, list[Any]()

    def get_inputs(self) -> list[Any]:
        return [SimpleNamespace(name=name, shape=["batch", *shape]) for name, shape in self.inputs.items()]

    def get_outputs(self) -> list[Any]:
        return [SimpleNamespace(name=name) for name in sorted(self.outputs)]

    def run(self, names: list[str], inputs: dict[str, Any]) -> list[Any]:
        self.fed.append(inputs)
        return [self.answer[name] for name in names]


def network(role: str, inputs: dict[str, Any], outputs: set[str], answer: Any = None, **card: Any) -> LoadedModel:
    described = tiny_models.card(role, card.pop("form", "step"), **card)
    return LoadedModel(Path(f"{role}.onnx"), described, "0" * 64, Session(inputs, outputs, answer))


@pytest.mark.parametrize(
    ("role", "card", "more"),
    [
        ("direction", {}, {}),
        ("magnitude", {}, {}),
        ("direction", {"gap_width_input": True}, {"gap_width_mm": [1]}),
        ("direction", {"grasp_height_input": True}, {"grasp_height_mm": [1]}),
    ],
)
def test_a_graph_takes_what_its_card_says_and_nothing_else(role: str, card: dict[str, Any], more: Any) -> None:
    inputs, outputs = STEP | more, GIVEN[role] | {"next_state"}
    _check_graph(network(role, inputs, outputs, **card))
    for wrong in ({**inputs, "other": [1]}, {**inputs, "frame": [2, 320, 327, 4]}, {**inputs, "state": [7]}):
        with pytest.raises(ModelError, match="takes inputs"):
            _check_graph(network(role, wrong, outputs, **card))
    for name in more:
        with pytest.raises(ModelError, match="takes inputs"):
            _check_graph(network(role, {key: value for key, value in inputs.items() if key != name}, outputs, **card))
    for name in outputs:
        with pytest.raises(ModelError, match=f"promises .*{name}"):
            _check_graph(network(role, inputs, outputs - {name}, **card))


def test_a_graph_of_whole_sequences_takes_them_at_once_and_passes_nothing_on() -> None:
    _check_graph(network("direction", {"frames": [8, *SHAPE]}, {"logits"}, form="sequence"))
    with pytest.raises(ModelError, match="takes inputs"):
        _check_graph(network("direction", STEP, {"logits", "next_state"}, form="sequence"))


@pytest.mark.parametrize("limit", [None, 4.0])
def test_a_graph_that_reads_depth_takes_its_conditions_and_tells_its_strangeness_where_that_is_limited(
    limit: float | None,
) -> None:
    outputs = {"logits", "error", "next_state"}
    pressing: Any = SimpleNamespace(strangeness_limit=limit)
    card: Any = SimpleNamespace(
        input_shape=(3, 4, 3), form="step", state_size=6, role="pair", has_sigma=False, pressing=pressing
    )
    card.gap_width_input = card.grasp_height_input = False
    inputs = {"frame": [2, 3, 4, 3], "reference": [2, 3, 4, 3], "state": [6], "conditions": [len(CONDITIONS)]}

    def made(outputs: set[str]) -> LoadedModel:
        return LoadedModel(Path("pair.onnx"), card, "0" * 64, Session(inputs, outputs))

    _check_graph(made(outputs | {"strangeness"}))
    if limit is None:
        _check_graph(made(outputs))
    else:
        with pytest.raises(ModelError, match="strangeness"):
            _check_graph(made(outputs))


def roles(*names: str) -> list[Any]:
    return [SimpleNamespace(card=SimpleNamespace(role=name), path=Path(f"{name}.onnx")) for name in names]


@pytest.mark.parametrize(
    ("names", "why"),
    [
        (("magnitude", "direction"), ""),
        (("joint",), ""),
        (("pair",), ""),
        (("joint", "direction"), "holds a joint step model beside .'direction', 'joint'."),
        (("pair", "magnitude"), "holds a pair step model beside .*; keep the pair one or the others"),
        (("direction",), "no magnitude step model"),
        (("magnitude",), "no direction step model"),
        ((), "no direction and magnitude step model"),
        (("direction", "direction"), "two direction step models"),
    ],
)
def test_two_networks_decide_together_or_one_alone(names: tuple[str, ...], why: str) -> None:
    candidates = roles(*names)
    if why:
        with pytest.raises(ModelError, match=why):
            _choose_steps(Path("models"), candidates)
        return
    assert [one.card.role for one in _choose_steps(Path("models"), candidates)] == sorted(names)


LOGITS = np.log(np.arange(1.0, 10.0))[None]


def set_of(**answers: dict[str, Any]) -> ModelSet:
    """Networks by role that answer the same to everything."""
    steps = []
    for role, answer in answers.items():
        whole = answer | {"next_state": np.zeros((1, tiny_models.STATE), np.float32)}
        steps.append(network(role, STEP, set(whole), whole, frames_per_decision=1, **GRID.get(role, {})))
    return ModelSet(tuple(steps), tuple(steps))


GRID: dict[str, Any] = {"joint": {"grid_x_mm": (-3.0, 0.0, 3.0), "grid_theta_deg": (-6.0, 0.0, 6.0)}}
JOINT = {"log_density": np.array([[[0.0, -50.0, -50.0], [-50.0, -50.0, -50.0], [-50.0, -50.0, -50.0]]])}
DIRECTION = {"logits": LOGITS}
MAGNITUDE = {"error": np.array([[2.0, -3.0]]), "log_sigma": np.log([[1.5, 2.0]])}
FRAME = np.zeros((2, 320, 327, 3), np.uint8)


def answer_of(models: ModelSet) -> Evidence:
    run = DecisionRun(models, FRAME, 56.0)
    assert (run.frames_n, run.step_ms) == (0, 0.0)
    run.step(FRAME)
    assert run.frames_n == 1
    return run.evidence()


def test_a_decision_comes_from_the_networks_that_are_there() -> None:
    assert answer_of(set_of(joint=JOINT)).error == pytest.approx((-3.0, -6.0))
    evidence = answer_of(set_of(direction=DIRECTION, magnitude=MAGNITUDE))
    assert evidence.error == (2.0, -3.0)
    assert evidence.probabilities == pytest.approx(np.arange(1.0, 10.0) / 45.0)


def test_a_step_took_as_many_milliseconds_as_the_clock_says(monkeypatch: pytest.MonkeyPatch) -> None:
    ticks_s = iter([100.0, 100.005])
    monkeypatch.setattr("service.decision.evidence.time.perf_counter", lambda: next(ticks_s))
    run = DecisionRun(set_of(joint=JOINT), FRAME, 56.0)
    run.step(FRAME)
    assert run.step_ms == pytest.approx(5.0)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_an_output_that_is_not_finite_is_refused_by_the_name_of_its_network(bad: float) -> None:
    for name, answer in (("direction", DIRECTION), ("magnitude", MAGNITUDE)):
        spoilt = {key: np.where(np.arange(value.size) == 0, bad, value) for key, value in answer.items()}
        both = {"direction": DIRECTION, "magnitude": MAGNITUDE} | {name: spoilt}
        with pytest.raises(Refusal, match=f"the {name} network gave a non-finite output"):
            answer_of(set_of(**both))


def test_an_error_that_is_not_finite_is_refused_before_a_sigma_is_read() -> None:
    cards = tiny_models.card("direction", "step"), tiny_models.card("magnitude", "step")
    with pytest.raises(Refusal, match="an error of"):
        from_pair(*cards, DIRECTION, {"error": np.array([[np.nan, 1.0]]), "log_sigma": np.zeros((1, 2))})
    joint = tiny_models.card("joint", "step", **GRID["joint"])
    with pytest.raises(Refusal, match="density that is not finite"):
        from_joint(joint, {"log_density": np.full((1, 3, 3), np.nan)})


def test_rows_of_logits_are_probabilities_each() -> None:
    rows = softmax(np.array([[0.0, np.log(3.0)], [1000.0, 1000.0]]))
    assert rows == pytest.approx(np.array([[0.25, 0.75], [0.5, 0.5]]))


def test_a_network_is_fed_the_geometry_and_conditions_that_it_asks_for() -> None:
    answer = DIRECTION | {"next_state": np.ones((1, 6), np.float32)}
    made = network("direction", STEP, set(answer), answer, gap_width_input=True, grasp_height_input=True)
    outputs, state = made.step(FRAME, FRAME, made.fresh_state(), 56.0, 40.0)
    assert set(outputs) == {"logits"}
    assert (state == 1.0).all()
    made.step(FRAME, FRAME, state, 56.0, None)
    first, second = made.session.fed
    assert (first["gap_width_mm"].tolist(), first["grasp_height_mm"].tolist()) == ([[56.0]], [[40.0]])
    assert (first["state"] == 0.0).all()
    assert first["state"].shape == (1, tiny_models.STATE)
    assert second["grasp_height_mm"].tolist() == [[0.0]], "unknown"
    assert first["frame"].shape == (1, *SHAPE)
