"""The paper's two AlexNet networks, the yardstick of speed, in the forms that the speed claims name.

Speed does not depend on weights, so without trained checkpoints random ones of the same shapes are exported, and the
report says so.
"""

from pathlib import Path

import numpy as np

from export.onnx.decisions import Decision, read_split
from export.onnx.golden import golden_frames
from export.onnx.model import open_model
from export.quantise.quantise import LARGE_CALIBRATION, quantize
from service.contract import ContractError

SEQUENCES = ("direction.sequence.onnx", "magnitude.sequence.onnx")
PAIR = Path("pair") / "pair.step.onnx"
RANDOM = "random-weights"


def files(folder: Path, data: str | None = None) -> dict[str, Path]:
    """Files of the yardstick by name; what is lacking is exported with random weights, int8 twins are kept up to date.

    ``folder`` holds the recipe as exported, ``<folder>_shared`` the same behind one whole AlexNet. Calibration takes
    real frames where ``data`` names a dataset, golden ones otherwise (speed is the same). Raises ContractError if one
    of the folders holds a part of a trained export only.
    """
    shared = folder.with_name(f"{folder.name}_shared")
    _ensure(folder, [folder / name for name in (*SEQUENCES, PAIR)], shared=False)
    _ensure(shared, [shared / PAIR], shared=True)
    found = {"direction": folder / SEQUENCES[0], "magnitude": folder / SEQUENCES[1]}
    for name, home in (("shared convolutions", folder), ("shared backbone", shared)):
        small = home / "pair" / "int8" / "pair.step.onnx"
        if not small.is_file() or small.stat().st_mtime < (home / PAIR).stat().st_mtime:  # of an earlier export
            quantize(home / PAIR, small, _calibration(home / PAIR, data))
        found |= {f"{name} fp32": home / PAIR, f"{name} int8": small}
    return found


def trained(found: dict[str, Path]) -> bool:
    """Whether all of the yardstick is of trained networks."""
    return not any(open_model(file).card.name.startswith(RANDOM) for file in found.values())


def _ensure(folder: Path, wanted: list[Path], *, shared: bool) -> None:
    missing = [file for file in wanted if not file.is_file()]
    if missing and len(missing) < len(wanted):
        raise ContractError(f"{missing[0]} is missing; export the checkpoint again into {folder}")
    if missing:
        _export_random(folder, shared=shared)


def _calibration(file: Path, data: str | None) -> list[Decision]:
    if data is not None:
        return list(read_split(data, "train", LARGE_CALIBRATION))
    spec, truth = open_model(file).card.frame, np.zeros(2, np.float32)
    return [Decision(golden_frames(spec, 8, seed), 56.0, 30.0, truth, "golden") for seed in range(2)]


def _export_random(folder: Path, *, shared: bool) -> None:
    import torch

    from export.onnx.to_onnx import export_checkpoint
    from training.config import NetworkConfig
    from training.data.labels import CLASSES
    from training.fit.checkpoint import Checkpoint
    from training.metrics.figures import Scales
    from training.networks.alexnet import AlexNetPair

    torch.manual_seed(0)
    both = AlexNetPair(len(CLASSES))
    ours, theirs = both.direction.alexnet, both.magnitude.alexnet
    (theirs if shared else theirs.features).load_state_dict((ours if shared else ours.features).state_dict())
    settings = NetworkConfig(kind="alexnet_lstm")
    folder.mkdir(parents=True, exist_ok=True)
    checkpoint = Checkpoint(RANDOM, settings, both.state_dict(), Scales(), Scales(), {}, "0" * 64, "none")
    path = folder / "random.pt"
    checkpoint.save(path)
    try:
        pair = ("pair.step",)
        export_checkpoint(path, folder, pair if shared else ("direction.sequence", "magnitude.sequence", *pair))
    finally:
        path.unlink()
