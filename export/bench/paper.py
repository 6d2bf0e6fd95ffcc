"""The paper's two AlexNet networks, the baseline of speed: a released step beside their whole sequence.

Speed does not depend on weights, so without trained checkpoints random ones of the same shapes are exported, and the
report says so.
"""

from itertools import chain
from pathlib import Path
from typing import Any

from export.bench.measure import example_inputs, quartiles, time_in_turn
from export.onnx.decisions import Decision
from export.onnx.model import Model, open_model
from export.quantise.quantise import MODES, quantise
from service.contract import ContractError

SEQUENCES = ("direction.sequence.onnx", "magnitude.sequence.onnx")
PAIR = Path("pair") / "pair.step.onnx"
RANDOM = "random-weights"
RELEASED_SHARE = 1 / 150
"""At most this share of two fp32 AlexNet sequence passes may a released step take, in processor time."""
PASSES = "two fp32 passes"


def compare(steps: list[Model], folder: Path, decisions: list[Decision], seconds: float) -> dict[str, Any]:
    """Steps of the released networks and of AlexNet behind one backbone, over two fp32 AlexNet sequence passes.

    All are called in turn on one thread, each after an untimed call of its own; processor time, median and quartiles
    of the ratios. A released step is that of all networks of one folder, as a service runs them. ``decisions``
    calibrate the int8 builds. Raises ContractError if ``folder`` holds a part of an export only.
    """
    folders = sorted({model.file.parent for model in steps})
    sets = {f"released: {home}": [model for model in steps if model.file.parent == home] for home in folders}
    shared = folder.with_name(f"{folder.name}_shared")
    sets[PASSES] = [open_model(file) for file in exported(folder, (*SEQUENCES, str(PAIR)))[:2]]
    (step,) = exported(shared, (str(PAIR),), shared=True)
    sets["shared convolutions fp32"] = [open_model(folder / PAIR)]
    sets["shared backbone fp32"] = [open_model(step)]
    sets |= {f"shared backbone int8 {mode}": [model] for mode, model in _int8(step, decisions).items()}
    inputs = {id(model): example_inputs(model) for model in chain(*sets.values())}
    calls = {name: _all(models, inputs) for name, models in sets.items()}
    rows = time_in_turn(calls, seconds=10 * seconds, least=12, warm=True)
    base = rows.pop(PASSES)
    return {
        "trained": not any(model.card.name.startswith(RANDOM) for model in chain(*sets.values())),
        "passes_cpu_ms": base[0].cpu_p50_ms,
        "rows": [
            {
                "what": name,
                "files": [model.file.name for model in sets[name]],
                "cpu_p50_ms": timing.cpu_p50_ms,
                "ratio": quartiles(spent[1], base[1][1]),
                "claim": RELEASED_SHARE if name.startswith("released") else None,
            }
            for name, (timing, spent) in rows.items()
        ],
    }


def _all(models: list[Model], inputs: dict[int, Any]) -> Any:
    return lambda: [model(inputs[id(model)]) for model in models]


def _int8(step: Path, decisions: list[Decision]) -> dict[str, Model]:
    """int8 builds of a step by mode, made again each time; one that is refused is left out with a line that says so."""
    builds = dict[str, Model]()
    for mode in MODES:
        try:
            builds[mode] = open_model(quantise(step, step.parent / f"int8-{mode}" / step.name, decisions, mode))
        except ContractError as error:
            print(f"left out: {error}")
    return builds


def exported(folder: Path, names: tuple[str, ...], *, shared: bool = False) -> list[Path]:
    """Files of an exported recipe; written with random weights if there is none, ContractError if there is a part."""
    files = [folder / name for name in names]
    missing = [file for file in files if not file.is_file()]
    if missing and len(missing) < len(files):
        raise ContractError(f"{missing[0]} is missing; export the checkpoint again into {folder}")
    if missing:
        export_random(folder, shared=shared)
    return files


def export_random(folder: Path, *, shared: bool) -> None:
    """Write the paper's networks with random weights, ``shared`` behind one whole AlexNet (then the step alone)."""
    import torch

    from export.onnx.to_onnx import export_checkpoint
    from training.data.labels import CLASSES
    from training.fit.checkpoint import Checkpoint
    from training.metrics.figures import Scales
    from training.networks.alexnet import AlexNetPair
    from training.networks.settings import NetworkConfig

    torch.manual_seed(0)
    settings = NetworkConfig(kind="alexnet_lstm")
    both = AlexNetPair(settings, len(CLASSES))
    ours, theirs = both.direction.alexnet, both.magnitude.alexnet
    (theirs if shared else theirs.features).load_state_dict((ours if shared else ours.features).state_dict())
    folder.mkdir(parents=True, exist_ok=True)
    checkpoint = Checkpoint(RANDOM, settings, both.state_dict(), Scales(), Scales(), {}, "0" * 64, "none")
    path = folder / "random.pt"
    checkpoint.save(path)
    try:
        pair = ("pair.step",)
        export_checkpoint(path, folder, pair if shared else ("direction.sequence", "magnitude.sequence", *pair))
    finally:
        path.unlink()
