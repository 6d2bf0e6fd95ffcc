import numpy as np
import onnx
import pytest

from export.onnx.decisions import Decision
from export.onnx.golden import golden_frames
from export.onnx.model import open_model
from export.onnx.verify import decide, verify_model
from export.quantise.agreement import same_commands
from export.quantise.quantise import MODES, FarOffError, quantise
from service.contract import ContractError

WITHIN = {"static": 0.2, "dynamic": 0.05, "blocked": 0.05}


@pytest.fixture(scope="module")
def decisions(models):
    spec = open_model(models / "direction.step.onnx").card.frame
    return [Decision(golden_frames(spec, 8, seed), 56.0, 30.0) for seed in range(3)]


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
    assert same_commands([source], [build], decisions) == 3


def test_commands_that_differ_are_not_the_same(models, decisions):
    source = open_model(models / "pair" / "pair.step.onnx")

    def doubled(inputs):
        return {name: 2 * value if name == "error" else value for name, value in source(inputs).items()}

    other = type("Doubled", (), {"card": source.card, "__call__": staticmethod(doubled)})()
    assert same_commands([source], [other], decisions) == 0


def test_an_int8_model_is_not_quantised_again(blocked, decisions, tmp_path):
    with pytest.raises(ContractError, match="expected an fp32 step release"):
        quantise(blocked / "pair.step.onnx", tmp_path / "again.onnx", decisions)


def test_a_blocked_build_decides_alike_in_a_batch_on_two_threads_and_stays_bounded(blocked):
    lines = verify_model(open_model(blocked / "pair.step.onnx"), stream_steps=20)
    assert any("1 against 64 in a batch" in line for line in lines)
    assert any("bounded on" in line for line in lines)
