from dataclasses import replace

import numpy as np
import pytest
import torch

from service.contract import ContractError
from tests.training.synthetic import SyntheticSource
from training.config import RecipeConfig, StageConfig
from training.data.dataset import load_table
from training.data.recipe_data import _convolved
from training.fit.checkpoint import Checkpoint
from training.fit.recipe import train_recipe
from training.networks.alexnet import FEATURES, AlexNetLstm, AlexNetPair, difference_images, load_imagenet
from training.networks.forms import SequenceForm, StepForm

TORCHVISION = {
    "features.0": (64, 3, 11, 11),
    "features.3": (192, 64, 5, 5),
    "features.6": (384, 192, 3, 3),
    "features.8": (256, 384, 3, 3),
    "features.10": (256, 256, 3, 3),
    "classifier.1": (4096, 9216),
    "classifier.4": (4096, 4096),
    "classifier.6": (1000, 4096),
}


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    return AlexNetLstm(9).eval()


def imagenet_like():
    """Tensors of the right shapes, of one number each: a file of them takes a kilobyte instead of 244 MB."""
    weight, bias = torch.tensor(0.5), torch.tensor(0.25)
    shapes = TORCHVISION.items()
    weights = {f"{name}.weight": weight.expand(shape) for name, shape in shapes}
    return weights | {f"{name}.bias": bias.expand(shape[:1]) for name, shape in shapes}


def test_an_imagenet_state_dict_loads_under_torchvisions_names(tmp_path):
    torch.save(imagenet_like(), tmp_path / "alexnet.pth")
    network = AlexNetLstm(9)
    load_imagenet(network, tmp_path / "alexnet.pth")
    assert all(bool((value == 0.5).all()) for name, value in network.alexnet.named_parameters() if "weight" in name)


@pytest.mark.parametrize("what", ["missing", "empty", "a text", "a key less", "no state dict"])
def test_weights_that_do_not_fit_are_refused_by_name(tmp_path, network, what):
    path = tmp_path / "alexnet.pth"
    if what == "a key less":
        weights = imagenet_like()
        del weights["features.8.bias"]
        torch.save(weights, path)
    elif what == "no state dict":
        torch.save([1, 2], path)
    elif what != "missing":
        path.write_text("" if what == "empty" else "hello")
    with pytest.raises(ContractError, match=r"alexnet\.pth"):
        load_imagenet(network, path)


def test_the_difference_is_taken_after_the_cast_and_in_rgb_order():
    frame = torch.zeros(1, 320, 327, 3, dtype=torch.uint8)
    reference = torch.full_like(frame, 10)
    reference[..., 0] = 200  # blue
    images = difference_images(frame, reference)
    assert images.shape == (1, 3, 224, 224)
    assert bool((images < 0).all())
    assert bool((images[:, 2] < images[:, 0]).all())


def test_the_step_form_decides_as_the_sequence_form(network):
    frames = torch.randint(0, 256, (1, 8, 2, 320, 327, 3), dtype=torch.uint8)
    with torch.no_grad():
        whole = SequenceForm(network, "direction")(frames)[0]
        state = torch.zeros(1, network.state_size)
        for index in range(8):
            logits, state = StepForm(network, "direction")(frames[:, index], frames[:, 0], state)
    assert torch.allclose(whole, logits, atol=1e-5)


class Ones(torch.nn.Module):
    device = torch.device("cpu")

    def convolved(self, images):
        return torch.ones(len(images), FEATURES)


@pytest.mark.parametrize("left", ["the number of rows alone", "a number that a kill cut short"])
def test_features_that_are_not_there_are_computed_and_not_taken_for_zeros(tmp_path, left):
    stage = StageConfig(epochs=1)
    config = RecipeConfig(
        name="t", runs=str(tmp_path), data="unused", convolutions=stage, direction=stage, magnitude=stage
    )
    config.folder.mkdir()
    source = SyntheticSource(3)
    table = load_table(source, tmp_path / "cache", 3)
    which = table, Ones(), np.arange(1), np.zeros(1, bool)
    assert _convolved(config, source, *which).min() == 1.0
    if left == "the number of rows alone":
        (config.folder / "features.npy").unlink()
    else:
        (config.folder / "features.done").write_text("")
    assert _convolved(config, source, *which).min() == 1.0


def tiny_recipe(folder):
    stage = StageConfig(epochs=1, batch=8, learning_rate=1e-4, weight_decay=0.0)
    return RecipeConfig(
        name="tiny",
        runs=str(folder / "runs"),
        data="unused",
        cache=str(folder / "cache"),
        pretraining_trials=4,
        convolutions=stage,
        direction=stage,
        magnitude=stage,
    )


@pytest.mark.parametrize("lacking", ["train", "validation"])
def test_a_recipe_without_trials_to_train_on_or_to_validate_with_is_refused(tmp_path, lacking):
    source = SyntheticSource(10)
    source.trials = [replace(trial, split="test" if trial.split == lacking else trial.split) for trial in source.trials]
    config = tiny_recipe(tmp_path)
    with pytest.raises(ContractError, match=f"no collisions in its {lacking} split"):
        train_recipe(config, source)
    assert not list(config.folder.iterdir())


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_recipe_trains_resumes_and_keeps_both_networks(tmp_path):
    config = tiny_recipe(tmp_path)
    source = SyntheticSource(30)
    first = train_recipe(config, source)
    again = train_recipe(config, source)
    assert first.figures == again.figures
    assert again.run["epochs_trained"] == {"convolutions": 1, "direction": 1, "magnitude": 1}
    with pytest.raises(ContractError, match="another config"):
        train_recipe(config.model_copy(update={"data": "other probes"}), source)
    pair = Checkpoint.load(config.folder / "checkpoint.pt").build()
    assert isinstance(pair, AlexNetPair)
    shared, own = pair.direction.alexnet.features[0].weight, pair.magnitude.alexnet.features[0].weight
    assert torch.equal(shared, own)
    assert not torch.equal(pair.direction.lstm.weight_hh, pair.magnitude.lstm.weight_hh)
