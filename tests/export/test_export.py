import numpy as np
import onnx
import pytest

from export.verify import decide, open_model, verify
from service.contract import CARD_KEY, ContractError, ModelCard


def test_both_roles_and_forms_are_written_with_their_cards(models):
    cards = {file.name: open_model(file).card for file in models.glob("*.onnx")}
    assert set(cards) == {f"{role}.{form}.onnx" for role in ("direction", "magnitude") for form in ("step", "sequence")}
    assert cards["direction.step.onnx"].disagreements(cards["magnitude.step.onnx"]) == []
    assert cards["magnitude.step.onnx"].has_sigma
    assert cards["direction.step.onnx"].state_size == 16
    assert cards["direction.sequence.onnx"].calibration.temperature == 1.5
    assert cards["direction.step.onnx"].validation == {"accuracy": 0.5}


def test_released_models_verify(models):
    lines = verify(models)
    assert sum("=" in line for line in lines) == 2


def test_the_joint_density_verifies_in_a_folder_of_its_own(models):
    assert sum("=" in line for line in verify(models / "joint")) == 1
    card = open_model(models / "joint" / "joint.step.onnx").card
    assert (len(card.grid_x_mm), len(card.grid_theta_deg)) == (41, 40)


def test_the_graphs_weigh_little(models):
    assert all(file.stat().st_size < 4e6 for file in models.glob("*.onnx"))


def test_a_model_without_a_card_is_refused(models, tmp_path):
    model = onnx.load(str(models / "direction.step.onnx"))
    del model.metadata_props[:]
    onnx.save(model, str(tmp_path / "bare.onnx"))
    with pytest.raises(ContractError, match="carries no model card"):
        verify(tmp_path)


def test_a_foreign_card_is_refused(models, tmp_path):
    model = onnx.load(str(models / "direction.step.onnx"))
    onnx.helper.set_model_props(model, {CARD_KEY: '{"schema_version": 7}'})
    onnx.save(model, str(tmp_path / "foreign.onnx"))
    with pytest.raises(ContractError, match="invalid model card"):
        verify(tmp_path)


def test_a_card_that_promises_other_inputs_is_refused(models, tmp_path):
    card = open_model(models / "direction.step.onnx").card
    model = onnx.load(str(models / "direction.step.onnx"))
    del model.metadata_props[:]
    onnx.helper.set_model_props(model, card.model_copy(update={"gap_width_input": False}).to_props())
    onnx.save(model, str(tmp_path / "liar.onnx"))
    with pytest.raises(ContractError, match="its card promises"):
        verify(tmp_path)


@pytest.mark.parametrize("content", [b"", b"garbage", None])
def test_a_corrupt_file_is_refused(models, tmp_path, content):
    whole = (models / "direction.step.onnx").read_bytes()
    (tmp_path / "bad.onnx").write_bytes(whole[: len(whole) // 2] if content is None else content)
    with pytest.raises(ContractError, match=r"bad\.onnx"):
        verify(tmp_path)


def test_an_empty_folder_is_named(tmp_path):
    with pytest.raises(ContractError, match=r"no \.onnx file"):
        verify(tmp_path)


def test_a_model_whose_two_forms_differ_is_refused(models, tmp_path):
    for name in ("direction.step.onnx", "direction.sequence.onnx"):
        (tmp_path / name).write_bytes((models / name).read_bytes())
    path = tmp_path / "direction.step.onnx"
    model = onnx.load(str(path))
    for tensor in model.graph.initializer:
        if tensor.name.endswith("direction.bias"):
            shifted = onnx.numpy_helper.to_array(tensor) + 1
            tensor.CopyFrom(onnx.numpy_helper.from_array(shifted.astype(np.float32), tensor.name))
    onnx.save(model, str(path))
    with pytest.raises(ContractError, match="differ by"):
        verify(tmp_path)


def test_float_frames_and_other_heights_are_refused_by_the_graph(models):
    model = open_model(models / "direction.sequence.onnx")
    assert isinstance(model.card, ModelCard)
    for bad in (np.zeros((1, 8, 2, 320, 327, 3), np.float32), np.zeros((1, 8, 2, 319, 327, 3), np.uint8)):
        with pytest.raises(Exception, match=r"(?i)invalid|unexpected|dimension|reshape"):
            decide(model, bad)
