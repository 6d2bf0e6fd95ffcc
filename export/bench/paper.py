"""The paper's two AlexNet networks as the baseline of speed: a released step against their whole sequence.

Speed does not depend on weights, so without trained checkpoints random ones of the same shapes are exported, and the
report says so.
"""

from pathlib import Path
from typing import Any

from export.bench.measure import quartiles, time_in_turn, together
from export.onnx.model import Model, open_model
from service.contract import ContractError

SEQUENCES = ("direction.sequence.onnx", "magnitude.sequence.onnx")
RANDOM = "random-weights"
RELEASED_SHARE = 1 / 150
"""Largest share of two fp32 AlexNet sequence passes that a released step may take, in processor time."""
PASSES = "two fp32 passes"


def compare(steps: list[Model], folder: Path, seconds: float) -> dict[str, Any]:
    """Ratios of the released networks' steps to two fp32 AlexNet sequence passes.

    All are called in turn on one thread, each after an untimed call of its own; processor time, median and quartiles of
    the ratios. A released step is that of all networks of one folder, as in the service. Raises ContractError if
    ``folder`` holds only a part of an export.
    """
    folders = sorted({model.file.parent for model in steps})
    sets = {str(home): [model for model in steps if model.file.parent == home] for home in folders}
    sets[PASSES] = [open_model(file) for file in exported(folder)]
    rows = time_in_turn({name: together(models) for name, models in sets.items()}, seconds=seconds, least=12, warm=True)
    base = rows.pop(PASSES)
    return {
        "trained": not sets[PASSES][0].card.name.startswith(RANDOM),
        "passes_cpu_ms": base[0].cpu_p50_ms,
        "rows": [
            {"folder": name, "cpu_p50_ms": timing.cpu_p50_ms, "ratio": quartiles(spent[1], base[1][1])}
            for name, (timing, spent) in rows.items()
        ],
    }


def exported(folder: Path) -> list[Path]:
    """Files of an exported recipe; written with random weights if there is none, ContractError if it is incomplete."""
    files = [folder / name for name in SEQUENCES]
    missing = [file for file in files if not file.is_file()]
    if missing and len(missing) < len(files):
        raise ContractError(f"{missing[0]} is missing; export the checkpoint again into {folder}")
    if missing:
        _export_random(folder)
    return files


def _export_random(folder: Path) -> None:
    import torch

    from export.onnx.to_onnx import export_checkpoint
    from training.data.labels import CLASSES
    from training.fit.checkpoint import Checkpoint
    from training.metrics.figures import Scales
    from training.networks.alexnet import AlexNetPair
    from training.networks.settings import NetworkConfig

    torch.manual_seed(0)
    settings = NetworkConfig(kind="alexnet_lstm")
    weights = AlexNetPair(settings, len(CLASSES)).state_dict()
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "random.pt"
    Checkpoint(RANDOM, settings, weights, Scales(), Scales(), {}, "0" * 64, "none").save(path)
    try:
        export_checkpoint(path, folder, tuple(name.removesuffix(".onnx") for name in SEQUENCES))
    finally:
        path.unlink()
