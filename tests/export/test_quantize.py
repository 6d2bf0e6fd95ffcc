import numpy as np
import pytest

from export.golden import golden_frames
from export.quantize import agreement, quantize
from export.verify import open_model
from service.contract import ContractError


@pytest.fixture(scope="module")
def frames(models):
    spec = open_model(models / "direction.step.onnx").card.frame
    return np.stack([golden_frames(spec, 8, seed) for seed in range(3)])


@pytest.fixture(scope="module")
def small(models, frames, tmp_path_factory):
    folder = tmp_path_factory.mktemp("int8")
    for name in ("direction.step.onnx", "magnitude.step.onnx"):
        quantize(models / name, folder / name, frames)
    return folder


def test_the_int8_twin_says_what_it_is(small):
    assert open_model(small / "direction.step.onnx").card.quantisation == "int8"


def test_a_model_agrees_with_itself_on_every_command(models, frames):
    direction, magnitude = (open_model(models / f"{role}.step.onnx") for role in ("direction", "magnitude"))
    result = agreement((direction, direction), (magnitude, magnitude), frames)
    assert (result.same_class, result.same_command, result.sign_flips) == (1.0, 1.0, 0)


def test_an_int8_model_is_not_quantised_again(small, frames, tmp_path):
    with pytest.raises(ContractError, match="already int8"):
        quantize(small / "direction.step.onnx", tmp_path / "again.onnx", frames)
