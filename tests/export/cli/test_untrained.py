"""A network that guesses is not exported unless somebody insists."""

import pytest
import torch

from export.onnx.to_onnx import why_untrained
from service.contract import Sensor
from training.data.labels import CLASSES
from training.fit.checkpoint import Checkpoint
from training.metrics.figures import Scales
from training.networks import build
from training.networks.settings import NetworkConfig


@pytest.mark.parametrize(
    ("figures", "why"),
    [
        ({"accuracy": 0.80, "chance": 0.2, "trials": 300.0}, ""),
        ({"accuracy": 0.23, "chance": 0.2, "trials": 300.0}, "23% of 300 directions are right, and guessing gives 20%"),
        ({"accuracy": 0.60, "chance": 0.2, "trials": 4.0}, "60% of 4 directions are right, and guessing gives 20%"),
        ({}, "its directions were never validated"),
    ],
)
def test_what_is_no_better_than_a_guess_is_called_untrained(figures, why, tmp_path):
    torch.manual_seed(0)
    settings = NetworkConfig(front_width=8, trunk_width=8, feature_size=16, state_size=16)
    weights = build(settings, len(CLASSES), Sensor.load()).state_dict()
    told = {"validation/all": figures} if figures else {}
    Checkpoint("guess", settings, weights, Scales(), Scales(), told, "0" * 64, "abc").save(tmp_path / "c.pt")
    assert why_untrained(tmp_path / "c.pt") == why
