import numpy as np
import onnx
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from export.bench.alexnet import PAIR, _export_random
from export.blocks import REACH, block_of, round_weights
from export.onnx.decisions import Decision
from export.onnx.golden import golden_frames
from export.onnx.model import open_model
from export.onnx.verify import decide, verify_model
from export.quantise.quantise import quantize
from export.tradeoff.agreement import Agreement
from export.tradeoff.candidates import find_candidates
from export.tradeoff.scores import score
from export.tradeoff.tradeoff import agreements
from export.trunk import resizing_weights, saturates
from service.contract import ContractError
from training.networks.alexnet import difference_images


@pytest.fixture(scope="module")
def decisions(models):
    spec = open_model(models / "direction.step.onnx").card.frame
    return [Decision(golden_frames(spec, 8, seed), 56.0, 30.0, np.zeros(2, np.float32), "golden") for seed in range(3)]


@pytest.fixture(scope="module")
def small(models, decisions, tmp_path_factory):
    folder = tmp_path_factory.mktemp("int8")
    quantize(models / "pair" / "pair.step.onnx", folder / "pair.step.onnx", decisions[:1])
    return folder


def test_the_int8_twin_says_what_it_is_and_carries_its_own_test(small):
    card = open_model(small / "pair.step.onnx").card
    assert card.quantisation == "int8"
    assert len(card.self_test.outputs["logits"]) == 9


def test_the_int8_twin_keeps_the_commands_in_less_space(small, models, decisions):
    candidates = find_candidates([models / "pair", small])
    (row,) = agreements(candidates, score(candidates, decisions))
    assert (row["same_command"], row["sign_flips"]) == (1.0, 0)
    sizes = [(folder / "pair.step.onnx").stat().st_size for folder in (small, models / "pair")]
    assert sizes[0] < sizes[1]


def test_a_dynamic_twin_multiplies_its_larger_layers_in_int8(models, decisions, tmp_path, monkeypatch):
    monkeypatch.setattr("export.quantise.quantise.WORTH_A_PRODUCT", 700)  # the network is tiny
    twin = quantize(models / "pair" / "pair.step.onnx", tmp_path / "pair.step.onnx", decisions[:1], dynamic=True)
    kinds = [node.op_type for node in onnx.load(str(twin)).graph.node]
    assert kinds.count("MatMulNBits") == 3  # the projection and both products of the recurrent cell
    assert kinds.count("Gemm") == 2  # the heads


def test_commands_that_point_the_other_way_are_counted():
    classes = np.zeros(4, np.int64)
    ours = np.array([[1.0, 1.0], [1.0, 1.0], [0.02, 1.0], [1.0, 1.0]])
    theirs = np.array([[1.0, 1.0], [-1.0, 1.0], [-0.02, 1.0], [1.05, 1.3]])
    found = Agreement.of((classes, classes), (ours, theirs))
    assert (found.same_commands, found.sign_flips) == (2, 2)
    assert "50.0 % [" in str(found)


@given(rows=st.integers(1, 6), depth=st.integers(1, 70), seed=st.integers(0, 99))
@settings(max_examples=25, deadline=None)
def test_a_weight_without_calibration_goes_to_its_nearest_step(rows, depth, seed):
    weight = np.random.default_rng(seed).normal(size=(rows, depth))
    block = block_of(depth)
    found = round_weights(weight, None, block)
    scale = np.repeat(found.scale, block, 1)[:, :depth]
    assert np.abs(found.steps).max() == REACH
    assert np.abs(found.steps * scale - weight).max() <= 0.5001 * scale.max()


def test_rounding_against_what_a_layer_reads_changes_its_outputs_less():
    rng = np.random.default_rng(0)
    weight = rng.normal(size=(16, 64))
    read = rng.normal(size=(500, 8)) @ rng.normal(size=(8, 64))  # inputs that go together, as features do

    def error(moments):
        found = round_weights(weight, moments, 32)
        return np.square(read @ (found.steps * np.repeat(found.scale, 32, 1) - weight).T).mean()

    assert error(read.T @ read) < 0.3 * error(None)


@given(depth=st.integers(1, 5000))
@settings(deadline=None)
def test_no_block_is_ragged(depth):
    assert depth % block_of(depth) == 0


def test_one_strided_product_resizes_and_turns_colours_like_the_network():
    rng = np.random.default_rng(0)
    frames, reference = rng.integers(0, 256, (2, 1, 320, 327, 3), dtype=np.uint8)
    wanted = difference_images(torch.from_numpy(frames), torch.from_numpy(reference))[0]
    change = (frames[0, :, 3:323].astype(np.float64) - reference[0, :, 3:323]).transpose(2, 0, 1)
    cells = torch.nn.functional.conv2d(torch.from_numpy(change)[None], torch.from_numpy(resizing_weights()), stride=10)
    made = cells[0].reshape(7, 7, 3, 32, 32).permute(2, 3, 0, 4, 1).reshape(3, 224, 224)
    assert float((made - wanted).abs().max()) < 1e-3  # torch finds its places in float32


def test_this_processor_is_asked_whether_its_products_saturate():
    assert isinstance(saturates(), bool)


def test_an_int8_model_is_not_quantised_again(small, decisions, tmp_path):
    with pytest.raises(ContractError, match="expected an fp32 step release"):
        quantize(small / "pair.step.onnx", tmp_path / "again.onnx", decisions)


def test_the_int8_twin_says_the_same_in_a_batch_on_two_threads_and_stays_bounded(small):
    lines = verify_model(open_model(small / "pair.step.onnx"), stream_steps=20)
    assert any("1 against 64 in a batch" in line for line in lines)
    assert any("bounded on" in line for line in lines)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_alexnet_in_int8_reads_bytes_and_decides_as_in_fp32(decisions, tmp_path):
    _export_random(tmp_path, shared=True)
    source = tmp_path / PAIR
    exact, twin = open_model(source), open_model(quantize(source, tmp_path / "int8.onnx", decisions[:1]))
    kinds = {node.op_type for node in onnx.load(str(twin.file)).graph.node}
    assert {"QLinearConv", "QGemm"} <= kinds
    assert not {"Resize", "Conv", "MatMulNBits"} & kinds
    frames = golden_frames(exact.card.frame, 8, 5)[None]
    wanted, got = decide(exact, frames), decide(twin, frames)
    for name, value in wanted.items():
        np.testing.assert_allclose(got[name], value, atol=0.02 * max(1.0, float(np.abs(value).max())))
