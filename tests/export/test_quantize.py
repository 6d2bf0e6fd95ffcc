import numpy as np
import onnx
import pytest

from export.golden import golden_frames
from export.quantize import Agreement, agreement, int8_layers, quantize, same_commands
from export.verify import open_model, verify_model
from service.contract import ContractError


@pytest.fixture(scope="module")
def frames(models):
    spec = open_model(models / "direction.step.onnx").card.frame
    return np.stack([golden_frames(spec, 8, seed) for seed in range(3)])


@pytest.fixture(scope="module")
def small(models, frames, tmp_path_factory):
    folder = tmp_path_factory.mktemp("int8")
    quantize(models / "direction.step.onnx", folder / "direction.step.onnx", frames)
    return folder


def test_the_int8_twin_says_what_it_is_and_carries_its_own_test(small):
    card = open_model(small / "direction.step.onnx").card
    assert card.quantisation == "int8"
    assert len(card.self_test.outputs["logits"]) == 9


def test_a_model_agrees_with_itself_on_every_command(models, frames):
    pair = tuple(open_model(models / f"{role}.step.onnx") for role in ("direction", "magnitude"))
    result = agreement(pair, pair, frames)
    assert (result.same_class, result.same_command, result.sign_flips) == (1.0, 1.0, 0)
    joint = (open_model(models / "joint" / "joint.step.onnx"),)
    assert agreement(joint, joint, frames).same_command == 1.0


def test_commands_that_point_the_other_way_are_counted():
    classes = np.zeros(4, np.int64)
    ours = np.array([[1.0, 1.0], [1.0, 1.0], [0.02, 1.0], [1.0, 1.0]])
    theirs = np.array([[1.0, 1.0], [-1.0, 1.0], [-0.02, 1.0], [1.05, 1.3]])
    found = Agreement.of((classes, classes), (ours, theirs))
    assert (found.same_commands, found.sign_flips) == (2, 2)
    assert "50.0 % [" in str(found)


def test_only_layers_that_leave_the_commands_alone_become_int8(models, frames, tmp_path):
    source = models / "pair" / "pair.step.onnx"
    twin, layers = quantize(source, tmp_path / "pair.step.onnx", frames[:1], frames)
    exact, small = open_model(source), open_model(twin)
    assert layers
    assert agreement((exact,), (small,), frames).same_command == 1.0
    assert same_commands(
        exact.card, {"logits": np.eye(9), "error": np.ones((9, 2))}, {"logits": np.eye(9), "error": np.ones((9, 2))}
    ).all()


def test_a_layer_that_reads_a_frame_beside_its_change_stays_fp32(models):
    file = models / "pair" / "pair.step.onnx"
    convolutions = [node.name for node in onnx.load(str(file)).graph.node if node.op_type == "Conv"]
    assert set(convolutions) - set(int8_layers(file)) == {convolutions[0]}


def test_an_int8_model_is_not_quantised_again(small, frames, tmp_path):
    with pytest.raises(ContractError, match="already int8"):
        quantize(small / "direction.step.onnx", tmp_path / "again.onnx", frames)


def test_the_int8_twin_says_the_same_in_a_batch_on_two_threads_and_stays_bounded(small):
    lines = verify_model(open_model(small / "direction.step.onnx"), stream_steps=20)
    assert any("1 against 64 in a batch" in line for line in lines)
    assert any("bounded on" in line for line in lines)
