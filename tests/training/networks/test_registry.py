"""A new network is one file and one line; an unknown kind or key is refused by name."""

import importlib.util
import logging

import pytest

from export.onnx.model import open_model
from export.onnx.to_onnx import export_checkpoint
from export.onnx.verify import verify
from service.contract import ContractError, Sensor
from training import networks
from training.config import RecipeConfig, RunConfig
from training.fit.train import train

TOY = '''
"""Mean motion of each finger's markers, a linear layer, and the recurrent cell that every network has."""

import torch
from torch import Tensor, nn

from service.contract import Sensor
from training.networks.decider import Decider
from training.networks.settings import NetworkConfig


class MeanMotion(nn.Module):
    affine = None

    def __init__(self, settings: NetworkConfig) -> None:
        super().__init__()
        self.project = nn.Linear(6, settings.feature_size)
        self.cell = nn.GRUCell(settings.feature_size + 2, settings.state_size)

    def encode(self, fields: Tensor) -> Tensor:
        return torch.relu(self.project(fields.mean((3, 4)).flatten(1)))

    def advance(self, features: Tensor, geometry: Tensor, state: Tensor) -> Tensor:
        return self.cell(torch.cat([features, geometry / 100.0], 1), state)


class MeanMotionNetwork(Decider):
    reads_markers = True

    def __init__(self, settings: NetworkConfig, classes: int, sensor: Sensor) -> None:
        super().__init__(settings, classes, sensor)
        self.trunk = MeanMotion(settings)

    def features(self, frame: Tensor, reference: Tensor) -> Tensor:
        return self.trunk.encode((frame - reference).movedim(-1, -3))

    def normalised(self, fields: Tensor) -> Tensor:
        return fields

    def disturbed(self, fields: Tensor, front_error: Tensor) -> Tensor:
        return fields

    def read_drawn(self, drawn: Tensor) -> Tensor:
        return (drawn - drawn[:, :1]).movedim(-1, -3)
'''


@pytest.fixture
def toy(tmp_path, monkeypatch):
    file = tmp_path / "mean_motion.py"
    file.write_text(TOY)
    spec = importlib.util.spec_from_file_location("mean_motion", file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setitem(networks.NETWORKS, "mean_motion", module.MeanMotionNetwork)


@pytest.mark.slow
@pytest.mark.usefixtures("toy")
def test_a_new_network_of_one_file_and_one_line_trains_and_is_exported(config, source, tmp_path):
    size = config.network.model_copy(update={"kind": "mean_motion"})
    checkpoint = train(config.model_copy(update={"network": size}), source)
    assert checkpoint.figures["validation/all"]["trials"] > 0
    logging.disable(logging.INFO)
    try:
        export_checkpoint(config.folder / "checkpoint.pt", tmp_path, ("direction.step", "direction.sequence"))
    finally:
        logging.disable(logging.NOTSET)
    assert open_model(tmp_path / "direction.step.onnx").card.markers is not None
    assert any("direction.step.onnx = direction.sequence.onnx" in line for line in verify(tmp_path, stream_steps=20))


RUN = """
name = "a"
[data]
path = "x"
[trunk]
epochs = 1
"""
STAGES = "".join(f"[{stage}]\nepochs = 1\n" for stage in ("convolutions", "direction", "magnitude"))


@pytest.mark.parametrize(
    ("text", "refusal"),
    [
        (RUN + "[network]\nkind = 'compakt'", "network.kind: 'compakt' is unknown; did you mean 'compact'?"),
        (
            RUN + "[network]\nkind = 'q'",
            "network.kind: 'q' is unknown; allowed: alexnet_lstm, compact, markers, pressing",
        ),
        (RUN + "[network]\nfront_widht = 8", "network.front_widht: unknown key; did you mean 'front_width'?"),
        ("treads = 2" + RUN, "treads: unknown key; did you mean 'threads'?"),
        (RUN + "epoch = 1", "trunk.epoch: unknown key; did you mean 'epochs'?"),
    ],
)
def test_an_unknown_kind_or_key_of_a_run_is_refused_with_file_key_and_the_nearest(tmp_path, text, refusal):
    path = tmp_path / "run.toml"
    path.write_text(text)
    with pytest.raises(ContractError) as refused:
        RunConfig.load(path)
    assert str(refused.value).startswith(f"{path}: {refusal}")


def test_an_unknown_key_of_a_recipe_is_refused_with_the_nearest(tmp_path):
    path = tmp_path / "recipe.toml"
    path.write_text(f"name = 'a'\ndata = 'x'\nimagnet = 'y'\n{STAGES}")
    with pytest.raises(ContractError, match=r"recipe\.toml: imagnet: unknown key; did you mean 'imagenet'\?"):
        RecipeConfig.load(path)


def test_a_checkpoint_of_an_unknown_kind_is_refused_by_name(config):
    with pytest.raises(ContractError, match="'other' is unknown"):
        networks.build(config.network.model_copy(update={"kind": "other"}), 9, Sensor.load())
