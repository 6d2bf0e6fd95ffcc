import logging
import shutil

import pytest
import torch
from filelock import FileLock

from export.onnx.to_onnx import export_checkpoint
from service.contract import Sensor
from training.data.labels import CLASSES
from training.fit.checkpoint import Checkpoint
from training.metrics.figures import Scales
from training.networks import build
from training.networks.settings import NetworkConfig

EXPORTED = ("direction.step", "direction.sequence", "magnitude.step", "joint.step", "pair.step")


@pytest.fixture(scope="session")
def models(tmp_path_factory, worker_id):
    """A tiny untrained network, exported in all roles and both forms: by one worker, for all of them."""
    shared = tmp_path_factory.getbasetemp() if worker_id == "master" else tmp_path_factory.getbasetemp().parent
    folder = shared / "tiny-models"
    with FileLock(f"{folder}.lock"):
        if not folder.is_dir():
            export_tiny(shared / "tiny-models.part", EXPORTED)
            shutil.move(shared / "tiny-models.part", folder)
    return folder


def export_tiny(folder, only=()):
    """Export takes two seconds a file; most tests need no second file in sequence form."""
    torch.manual_seed(0)
    settings = NetworkConfig(front_width=8, trunk_width=8, feature_size=16, state_size=16)
    weights = build(settings, len(CLASSES), Sensor.load()).state_dict()
    figures = {"validation/all": {"accuracy": 0.5}}
    scales = Scales(1.5, 1.1, 0.9)
    Checkpoint("tiny", settings, weights, scales, Scales(), figures, "0" * 64, "abc", {"seed": 0}).save(folder / "c.pt")
    logging.disable(logging.INFO)  # pytest would format every line that torch traces
    try:
        export_checkpoint(folder / "c.pt", folder, only)
    finally:
        logging.disable(logging.NOTSET)
