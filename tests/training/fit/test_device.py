"""Runs on a GPU; those that need one are skipped without it."""

import pytest
import torch

from service.contract import ContractError
from tests.training.conftest import PRESSING
from tests.training.data.test_pressed import down
from tests.training.networks.test_alexnet import tiny_recipe
from tests.training.synthetic import SyntheticSource
from training.fit.recipe import train_recipe
from training.fit.train import Trainer, train

GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without a GPU")
def test_a_run_for_a_gpu_that_is_not_there_is_refused_and_leaves_no_folder(config, source):
    with pytest.raises(ContractError, match=r"device is cuda, but .* expected cpu"):
        train(config.model_copy(update={"device": "cuda"}), source)
    assert not config.folder.exists()


@pytest.fixture
def used(monkeypatch):
    """Kinds of the devices on which losses were computed."""
    kinds, loss = set(), Trainer.decision_loss

    def watched(trainer, fields, batch):
        kinds.add(fields.device.type)
        return loss(trainer, fields, batch)

    monkeypatch.setattr(Trainer, "decision_loss", watched)
    return kinds


def test_steps_are_computed_on_the_device_that_the_run_names(config, used):
    train(config.model_copy(update={"network": PRESSING}), down(20))
    assert used == {"cpu"}
    if torch.cuda.is_available():
        used.clear()
        train(config.model_copy(update={"network": PRESSING, "name": "there", "device": "cuda"}), down(20))
        assert used == {"cuda"}


@GPU
def test_a_network_that_reads_depth_learns_on_a_gpu_what_it_learns_on_the_cpu(config):
    here = config.model_copy(update={"network": PRESSING})
    there = here.model_copy(update={"name": "there", "device": "cuda"})
    one, other = train(here, down(60)), train(there, down(60))
    assert all(weight.device.type == "cpu" for weight in other.weights.values())
    for name in ("nll", "rmse_x_mm", "rmse_theta_deg"):  # weights drift apart by rounding, step by step
        assert other.figures["validation/all"][name] == pytest.approx(one.figures["validation/all"][name], rel=0.02)
    again = train(there, down(60))  # it resumes at its end
    assert all(torch.equal(other.weights[name], again.weights[name]) for name in other.weights)


@GPU
@pytest.mark.parametrize("kind", ["compact", "markers"])
def test_a_network_that_reads_frames_learns_on_a_gpu(config, source, kind, used):
    network = config.network.model_copy(update={"kind": kind})
    checkpoint = train(config.model_copy(update={"network": network, "device": "cuda"}), source)
    assert used == {"cuda"}
    assert all(torch.isfinite(weight).all() and weight.device.type == "cpu" for weight in checkpoint.weights.values())


@GPU
def test_the_recipe_trains_on_a_gpu(tmp_path):
    config = tiny_recipe(tmp_path).model_copy(update={"device": "cuda"})
    checkpoint = train_recipe(config, SyntheticSource(30))
    assert all(weight.device.type == "cpu" for weight in checkpoint.weights.values())
