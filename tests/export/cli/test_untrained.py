"""A network that guesses is not exported unless somebody insists."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from export.cli.commands import main
from export.onnx.model import open_model
from export.onnx.to_onnx import attach_card, make_card, why_untrained
from service.__main__ import main as service
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
def test_what_is_no_better_than_a_guess_is_called_untrained(figures, why):
    assert why_untrained(guess({"validation/all": figures} if figures else {})) == why


@pytest.mark.parametrize(("accuracy", "why"), [(0.8, ""), (0.2, "20% of 300 directions are right")])
def test_an_adapted_network_is_as_trained_as_its_release(accuracy, why):
    """Of 150 probes of one cell, 88 % may be of one class."""
    before = {"accuracy": accuracy, "chance": 0.2, "trials": 300.0}
    adapted = {"validation/all": {"accuracy": 0.92, "chance": 0.88, "trials": 150.0}, "trained/all": before}
    assert why_untrained(guess(adapted)).startswith(why)
    assert bool(why_untrained(guess(adapted))) == bool(why)


def guess(figures):
    torch.manual_seed(0)
    settings = NetworkConfig(front_width=8, trunk_width=8, feature_size=16, state_size=16)
    weights = build(settings, len(CLASSES), Sensor.load()).state_dict()
    return Checkpoint("guess", settings, weights, Scales(), Scales(), figures, "0" * 64, "abc")


def test_it_is_not_exported_unless_somebody_insists(tmp_path, capsys):
    guess({}).save(tmp_path / "c.pt")
    assert main(["onnx", str(tmp_path / "c.pt"), "--out", str(tmp_path / "models")]) == 2
    assert "never validated; --force exports it all the same" in capsys.readouterr().err
    assert not (tmp_path / "models").exists()


def test_the_card_of_an_adapted_network_says_of_what_its_figures_are(models, tmp_path, capsys):
    trained = {"accuracy": 0.8, "chance": 0.2, "trials": 300.0}
    checkpoint = replace(guess({"validation/all": trained}), run={"adapted": {"stage": "all"}})
    for role, figures in (("direction", trained), ("magnitude", {})):
        file = Path(shutil.copy(models / f"{role}.step.onnx", tmp_path))
        card = make_card(checkpoint, role, "step", checkpoint.build().of(role))
        attach_card(file, card.model_copy(update={"validation": figures}))
    assert service(["models", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "accuracy 0.8, chance 0.2, trials 300 (recordings of its cell)" in " ".join(out.split())
    assert "no figures (recordings of its cell)" in out


def test_the_card_of_one_that_guesses_says_so_to_whoever_asks(models, tmp_path, capsys):
    checkpoint = guess({})
    for role in ("direction", "magnitude"):
        file = shutil.copy(models / f"{role}.step.onnx", tmp_path)
        attach_card(Path(file), make_card(checkpoint, role, "step", checkpoint.build().of(role)))
        assert open_model(Path(file)).card.training_run["untrained"] == "its directions were never validated"
    assert service(["models", str(tmp_path)]) == 0
    assert capsys.readouterr().out.count("UNTRAINED: its directions were never validated") == 2
