import pytest
import torch

from export.to_onnx import export_checkpoint
from training.checkpoint import Checkpoint
from training.config import NetworkConfig
from training.evaluate import Scales
from training.labels import CLASSES
from training.networks import build


@pytest.fixture(scope="session")
def models(tmp_path_factory):
    """A tiny untrained pair, exported in both forms."""
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("models")
    settings = NetworkConfig(front_width=8, trunk_width=8, feature_size=16, state_size=16)
    weights = build(settings, len(CLASSES)).state_dict()
    figures = {"validation/all": {"accuracy": 0.5}}
    scales = Scales(1.5, 1.1, 0.9)
    Checkpoint("tiny", settings, weights, scales, Scales(), figures, "0" * 64, "abc").save(folder / "c.pt")
    export_checkpoint(folder / "c.pt", folder)
    return folder
