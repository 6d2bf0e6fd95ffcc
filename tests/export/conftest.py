import hashlib
import logging
import shutil
from pathlib import Path

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

ROOT = Path(__file__).parents[2]
EXPORTED = ("direction.step", "direction.sequence", "magnitude.step", "joint.step", "pair.step")


@pytest.fixture(scope="session")
def models(pytestconfig):
    """A tiny untrained network, exported in all roles and both forms; kept between runs as long as its makers are.

    Not to be written to.
    """
    kept = pytestconfig.cache.mkdir("tiny-models")
    with FileLock(kept / "lock"):
        folder = kept / makers()
        if not folder.is_dir():
            for old in kept.glob("*/"):
                shutil.rmtree(old)
            export_tiny(kept / "part", EXPORTED)
            shutil.move(kept / "part", folder)
    return folder


def makers():
    """Hash of torch's version and of all sources that an exported file may come from."""
    digest = hashlib.sha256(torch.__version__.encode())
    for place in ("training", "export", "service/contract", "tests/export/conftest.py"):
        path = ROOT / place
        for source in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


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
