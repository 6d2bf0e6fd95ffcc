"""The paper's two AlexNet networks, the yardstick of speed, in the forms that the speed claims name.

Speed does not depend on weights, so without a trained checkpoint random ones of the same shapes are exported, and the
report says so.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from export.golden import golden_frames
from export.quantize import quantize
from export.verify import open_model
from service.contract import ContractError

SEQUENCES = ("direction.sequence.onnx", "magnitude.sequence.onnx")
SHARED = "pair/pair.step.onnx"
SHARED_INT8 = "pair/int8/pair.step.onnx"
RANDOM = "random-weights"


def files(folder: Path, data: str | None = None) -> dict[str, Path]:
    """Files of the yardstick by name; what ``folder`` lacks is made: exported with random weights, then quantised.

    Calibration takes real frames where ``data`` names a dataset, golden ones otherwise (speed is the same). Raises
    ContractError if the folder holds a part of a trained export only.
    """
    wanted = [folder / name for name in (*SEQUENCES, SHARED)]
    missing = [file for file in wanted if not file.is_file()]
    if missing and len(missing) < len(wanted):
        raise ContractError(f"{missing[0]} is missing; export the checkpoint again into {folder}")
    if missing:
        _export_random(folder)
    if not (folder / SHARED_INT8).is_file():
        quantize(folder / SHARED, folder / SHARED_INT8, _frames(folder, data))
    return {"direction": wanted[0], "magnitude": wanted[1], "shared": wanted[2], "int8": folder / SHARED_INT8}


def trained(folder: Path) -> bool:
    """Whether the folder holds trained networks."""
    return open_model(folder / SHARED).card.name != f"{RANDOM}-pair"


def _frames(folder: Path, data: str | None) -> NDArray[np.uint8]:
    from training.dataset import read_decisions

    if data is not None:
        return read_decisions(data, 8)
    spec = open_model(folder / SHARED).card.frame
    return np.stack([golden_frames(spec, 8, seed) for seed in range(2)])


def _export_random(folder: Path) -> None:
    import torch

    from export.to_onnx import export_checkpoint
    from training.checkpoint import Checkpoint
    from training.config import NetworkConfig
    from training.evaluate import Scales
    from training.labels import CLASSES
    from training.networks.alexnet import AlexNetPair

    torch.manual_seed(0)
    pair = AlexNetPair(len(CLASSES))
    pair.magnitude.alexnet.features.load_state_dict(pair.direction.alexnet.features.state_dict())
    settings = NetworkConfig(kind="alexnet_lstm")
    folder.mkdir(parents=True, exist_ok=True)
    checkpoint = Checkpoint(RANDOM, settings, pair.state_dict(), Scales(), Scales(), {}, "0" * 64, "none")
    path = folder / "random.pt"
    checkpoint.save(path)
    try:
        export_checkpoint(path, folder)
    finally:
        path.unlink()
