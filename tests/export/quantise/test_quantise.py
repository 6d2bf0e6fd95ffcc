import numpy as np
import onnx
import pytest

from export.onnx.decisions import Decision
from export.onnx.golden import golden_frames
from export.onnx.model import open_model
from export.onnx.verify import decide, verify_model
from export.quantise.agreement import Agreement, compare
from export.quantise.quantise import MODES, FarOffError, quantise
from service.contract import ContractError

WITHIN = {"static": 0.2, "dynamic": 0.05, "blocked": 0.05}


@pytest.fixture(scope="module")
def decisions(models):
    spec = open_model(models / "direction.step.onnx").card.frame
    return [Decision(golden_frames(spec, 8, seed), 56.0, 30.0, np.zeros(2, np.float32), "golden") for seed in range(3)]


@pytest.fixture(scope="module")
def blocked(models, decisions, tmp_path_factory):
    folder = tmp_path_factory.mktemp("int8-blocked")
    quantise(models / "pair" / "pair.step.onnx", folder / "pair.step.onnx", decisions[:1])
    return folder


@pytest.mark.parametrize("mode", MODES)
def test_every_mode_makes_a_smaller_file_that_carries_its_own_test_and_decides_alike(mode, models, decisions, tmp_path):
    source = models / "pair" / "pair.step.onnx"
    build = open_model(quantise(source, tmp_path / source.name, decisions[:2], mode))
    assert build.card.quantisation == "int8"
    assert len(build.card.self_test.outputs["logits"]) == 9
    assert build.file.stat().st_size < source.stat().st_size
    for name, value in decide(open_model(source), decisions[2].frames[None]).items():
        actual = decide(build, decisions[2].frames[None])[name]
        assert np.abs(value - actual).max() < WITHIN[mode] * np.abs(value).max()


def test_a_blocked_build_multiplies_every_layer_but_the_convolutions_in_blocks(blocked):
    kinds = [node.op_type for node in onnx.load(str(blocked / "pair.step.onnx")).graph.node]
    assert kinds.count("MatMulNBits") == 5  # the projection, both products of the recurrent cell, two heads
    assert "Gemm" not in kinds


def test_a_build_that_computes_something_else_is_refused(models, decisions, tmp_path, monkeypatch):
    monkeypatch.setattr("export.quantise.quantise.FAR_OFF", 1e-6)
    with pytest.raises(FarOffError, match=r"direction\.step\.onnx: logits is off by 0 % of its size in int8"):
        quantise(models / "direction.step.onnx", tmp_path / "far.onnx", decisions[:1])


def test_commands_of_a_build_are_compared_with_those_of_its_source(blocked, models, decisions):
    source, build = (open_model(folder / "pair.step.onnx") for folder in (models / "pair", blocked))
    agreement = compare([source], [build], decisions)
    assert (agreement.same_commands, agreement.decisions, agreement.sign_flips) == (3, 3, 0)


def test_commands_that_point_the_other_way_are_counted():
    classes = np.zeros(4, np.int64)
    ours = np.array([[1.0, 1.0], [1.0, 1.0], [0.02, 1.0], [1.0, 1.0]])
    theirs = np.array([[1.0, 1.0], [-1.0, 1.0], [-0.02, 1.0], [1.05, 1.3]])
    agreement = Agreement.of((classes, classes), (ours, theirs))
    assert (agreement.same_commands, agreement.sign_flips) == (2, 2)
    assert "50.0 % (" in str(agreement)


def test_an_int8_model_is_not_quantised_again(blocked, decisions, tmp_path):
    with pytest.raises(ContractError, match="expected an fp32 step release"):
        quantise(blocked / "pair.step.onnx", tmp_path / "again.onnx", decisions)


def test_a_blocked_build_decides_alike_in_a_batch_on_two_threads_and_stays_bounded(blocked):
    lines = verify_model(open_model(blocked / "pair.step.onnx"), stream_steps=20)
    assert any("1 against 64 in a batch" in line for line in lines)
    assert any("bounded on" in line for line in lines)
