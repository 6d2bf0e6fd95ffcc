from pathlib import Path

import numpy as np
import onnx
import pytest

from service.contract import CARD_KEY, ContractError, ModelCard
from service.contract.model_card import CONDITIONS
from service.decision.evidence import DecisionRun, Refusal
from service.decision.models import ModelSet, load_models
from tests.service import tiny_models

RELEASED = Path(__file__).parents[3] / "models" / "pressing"


def test_a_missing_folder_says_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(ContractError, match="export them"):
        load_models(tmp_path / "none")


def test_a_model_without_a_card_is_refused(tmp_path: Path) -> None:
    folder = tiny_models.write_models(tmp_path)
    model = onnx.load(str(folder / "direction.step.onnx"))
    del model.metadata_props[:]
    onnx.save(model, str(folder / "direction.step.onnx"))
    with pytest.raises(ContractError, match=f"no model card \\({CARD_KEY}\\)"):
        load_models(folder)


def test_two_models_that_disagree_are_refused(tmp_path: Path) -> None:
    folder = tiny_models.write_models(tmp_path)
    onnx.save(tiny_models.step_model("magnitude", frames_per_decision=6), str(folder / "magnitude.step.onnx"))
    with pytest.raises(ContractError, match="disagree on frames_per_decision: tiny-direction says 8"):
        load_models(folder)


def test_networks_of_different_trainings_decide_together_with_a_caution(tmp_path: Path) -> None:
    folder = tiny_models.write_models(tmp_path, training_run={"seed": 1})
    assert load_models(folder).cautions == ()
    for changed in ({"training_run": {"seed": 2}}, {"training_run": {"seed": 1}, "training_data_sha256": "f" * 64}):
        onnx.save(tiny_models.step_model("magnitude", **changed), str(folder / "magnitude.step.onnx"))
        (caution,) = load_models(folder).cautions
        assert caution.startswith("tiny-direction and tiny-magnitude are from different trainings")


def test_garbage_is_no_model(tmp_path: Path) -> None:
    folder = tiny_models.write_models(tmp_path)
    (folder / "direction.step.onnx").write_bytes(b"not a model")
    with pytest.raises(ContractError, match="not a readable ONNX model"):
        load_models(folder)


def test_a_graph_that_is_not_what_its_card_says_is_refused(tmp_path: Path) -> None:
    folder = tiny_models.write_models(tmp_path)
    model = tiny_models.step_model("direction")
    lie = tiny_models.card("direction", "step", state_size=9)
    onnx.helper.set_model_props(model, lie.to_props())
    onnx.save(model, str(folder / "direction.step.onnx"))
    with pytest.raises(ContractError, match="its card says"):
        load_models(folder)


def test_a_graph_that_gives_other_classes_or_another_grid_than_its_card_is_refused(tmp_path: Path) -> None:
    folder = tiny_models.write_models(tmp_path / "pair")
    few = tiny_models.step_model("direction")
    onnx.helper.set_model_props(few, tiny_models.card("direction", "step", classes=tiny_models.CLASSES[:5]).to_props())
    onnx.save(few, str(folder / "direction.step.onnx"))
    with pytest.raises(ContractError, match=r"gives logits of \[9\], but its card promises \[5\]; export it again"):
        load_models(folder)
    joint = onnx.load(str(RELEASED.parent / "joint" / "joint.step.onnx"))
    card = ModelCard.from_props({entry.key: entry.value for entry in joint.metadata_props})
    narrow = card.model_copy(update={"grid_x_mm": card.grid_x_mm[:11], "self_test": None})
    onnx.helper.set_model_props(joint, narrow.to_props())
    onnx.save(joint, str(tmp_path / "joint.step.onnx"))
    with pytest.raises(ContractError, match=r"gives log_density of \[41, 40\], but its card promises \[11, 40\]"):
        load_models(tmp_path)


def test_a_network_that_reads_another_order_of_colours_is_refused(tmp_path: Path) -> None:
    folder = tiny_models.write_models(tmp_path)
    path = folder / "direction.step.onnx"
    model = onnx.load(str(path))
    for entry in model.metadata_props:
        entry.value = entry.value.replace('"colour":"bgr"', '"colour":"rgb"')
    onnx.save(model, str(path))
    with pytest.raises(ContractError, match=r"invalid model card: frame.colour"):
        load_models(folder)


@pytest.mark.parametrize(
    ("fault", "named"), [("type", r"expected: \(tensor\(float\)\)"), ("batch", "Got: 1 Expected: 2")]
)
def test_a_graph_that_does_not_run_on_what_its_card_says_is_refused(tmp_path: Path, fault: str, named: str) -> None:
    folder = tiny_models.write_models(tmp_path)
    path = folder / "direction.step.onnx"
    model = onnx.load(str(path))
    for entry in model.graph.input:
        if fault == "type":
            entry.type.tensor_type.elem_type = onnx.TensorProto.FLOAT
        else:
            entry.type.tensor_type.shape.dim[0].dim_value = 2
    onnx.save(model, str(path))
    with pytest.raises(ContractError, match=f"{path} does not run as its card says: .*{named}"):
        load_models(folder)


def test_a_decision_run_needs_all_its_frames_and_their_shape(models: ModelSet) -> None:
    frame = np.full((2, 320, 327, 3), 90, np.uint8)
    run = DecisionRun(models, frame, 56.0)
    for _ in range(7):
        run.step(frame)
    with pytest.raises(Refusal, match="7 frame pairs"):
        run.evidence()
    run.step(frame)
    evidence = run.evidence()
    assert evidence.probabilities.sum() == pytest.approx(1)
    assert evidence.sigma is not None
    with pytest.raises(ContractError, match="reads uint8"):
        run.step(frame[:, :100])


def test_what_is_not_known_of_an_attempt_is_read_as_nothing() -> None:
    """By the released networks that read depth, as their cards promise."""
    (step,) = load_models(RELEASED).steps
    still, state = np.zeros((2, *step.card.input_shape), np.float32), step.fresh_state()
    nothing = dict.fromkeys(CONDITIONS, 0.0)
    answers = [step.step(still, still, state, 56.0, *known)[0] for known in ((None, {}), (0.0, nothing))]
    other = step.step(still, still, state, 56.0, 40.0, nothing | {"grip_n": 30.0})[0]
    for name, value in answers[0].items():
        assert np.array_equal(value, answers[1][name])
    assert any(not np.array_equal(value, other[name]) for name, value in answers[0].items())


def test_state_is_passed_on_through_onnxruntime(models: ModelSet) -> None:
    step = models.steps[0]
    frame, dark = np.full((2, 320, 327, 3), 90, np.uint8), np.full((2, 320, 327, 3), 80, np.uint8)
    state = step.fresh_state()
    for expected in (10.0, 15.0, 17.5):
        _, state = step.step(frame, dark, state, 56.0)
        assert state == pytest.approx(np.full((1, 6), expected))
