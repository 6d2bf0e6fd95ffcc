"""Checks of released files: card, graph, equal forms, equal batches and threads, bounded outputs on hard inputs."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray

from export.onnx.golden import golden_input, hard_input
from export.onnx.model import Arrays, Model, geometry_inputs, open_model, steps
from service.contract import ContractError
from service.contract.self_test import check_self_test

LARGEST_OUTPUT = 1e4
OPSET = 20  # the newest that onnxruntime 1.17 reads
STREAM_STEPS = 10_000
CROWD = {"step": 64, "sequence": 8}
"""Batch with which a single decision is compared; 64 whole sequences would take gigabytes."""


def run_steps(model: Model, frames: NDArray[Any]) -> Arrays:
    """Final output of a step model for frames [B, T, 2, H, W, 3], the first one being the reference."""
    *_, outputs = steps(model, frames, frames.shape[1])
    return outputs


def decide(model: Model, frames: NDArray[Any]) -> Arrays:
    """The decision of either form on frames [B, T, 2, H, W, 3]."""
    if model.card.form == "step":
        outputs = run_steps(model, frames)
        return {name: value for name, value in outputs.items() if name != "next_state"}
    return model({"frames": frames} | geometry_inputs(model.card, len(frames)))


def verify(folder: Path, stream_steps: int = STREAM_STEPS) -> list[str]:
    """Verify every model of a folder; one line per check, ContractError on the first failure."""
    files = sorted(folder.glob("*.onnx"))
    if not files:
        raise ContractError(f"no .onnx file in {folder}; export with `python -m export onnx CHECKPOINT`")
    models = [open_model(file) for file in files]
    _check_agreement([model for model in models if model.card.form == "step"])
    lines = [f"{model.file.name}: {_check_file(model)}" for model in models]
    for model in models:
        lines += [f"{model.file.name}: {line}" for line in verify_model(model, stream_steps)]
    return lines + verify_forms(models)


def _check_agreement(decide_together: list[Model]) -> None:
    for one, other in pairwise(decide_together):
        if differs := one.card.disagreements(other.card):
            raise ContractError(f"{one.file.name} and {other.file.name} disagree on {'; '.join(differs)}")


def _check_file(model: Model) -> str:
    onnx.checker.check_model(str(model.file), full_check=True)
    opset = next(entry.version for entry in onnx.load(str(model.file)).opset_import if not entry.domain)
    if opset > OPSET:
        raise ContractError(f"{model.file.name} is of opset {opset}, expected at most {OPSET}; export it again")
    check_self_test(model.card, model, model.file.name)
    return f"card valid, graph checked (opset {opset}), self-test {'passed' if model.card.self_test else 'absent'}"


def verify_model(model: Model, stream_steps: int = STREAM_STEPS) -> list[str]:
    """Batch, thread and hard-input checks of one file."""
    card = model.card
    frames = golden_input(card)[None]
    alone = decide(model, frames)
    crowd = CROWD[card.form]
    batch_gap = _batch_gap(model, frames, crowd)
    threads_gap = _gaps(alone, decide(open_model(model.file, threads=2), frames))
    for what, gap in ((f"alone and among {crowd}", batch_gap), ("with one thread and two", threads_gap)):
        if not gap <= model.tolerance:
            raise ContractError(
                f"{model.file.name}: outputs {what} differ by {gap:.1e}, expected {model.tolerance:.0e}"
            )
    hard = hard_input(card)
    for name, strange in hard.items():
        _bounded(model, name, decide(model, strange[None]))
    lines = [
        f"1 against {crowd} in a batch to {batch_gap:.0e}, 1 thread against 2 to {threads_gap:.0e}",
        f"bounded on {', '.join(hard)}",
    ]
    if card.form == "step":
        lines += [_verify_states(model, frames), _verify_stream(model, frames, stream_steps)]
    return lines


def _batch_gap(model: Model, frames: NDArray[Any], crowd: int) -> float:
    """Difference of a decision alone and as one row of a batch; for a step model, of its last step."""
    place = crowd // 2
    if model.card.form == "sequence":
        rows = np.stack([np.roll(frames[0], row - place, axis=-2) for row in range(crowd)])
        alone, among = decide(model, frames), decide(model, rows)
    else:
        last = np.stack([np.roll(frames[0, -1], row - place, axis=-2) for row in range(crowd)])
        reference = np.repeat(frames[:, 0], crowd, 0)
        state = np.random.default_rng(3).uniform(-1, 1, (crowd, model.card.state_size)).astype(np.float32)
        among = model({"frame": last, "reference": reference, "state": state} | geometry_inputs(model.card, crowd))
        one: Arrays = {"frame": frames[:, -1], "reference": frames[:, 0], "state": state[place : place + 1]}
        alone = model(one | geometry_inputs(model.card, 1))
    return max(_gap(alone[name][0], among[name][place]) for name in alone)


def _verify_states(model: Model, frames: NDArray[Any]) -> str:
    """Recurrent states that no run reaches: +-1e4 (and thus logits of that order), and denormals, which equal zero."""
    outputs = {}
    states = {"zeros": 0.0, "denormals": 1e-40, "+1e4": 1e4, "-1e4": -1e4}
    for name, value in states.items():
        state = np.full((1, model.card.state_size), value, np.float32)
        inputs: Arrays = {"frame": frames[:, -1], "reference": frames[:, 0], "state": state}
        outputs[name] = model(inputs | geometry_inputs(model.card, 1))
        if not all(np.isfinite(value).all() for value in outputs[name].values()):
            raise ContractError(f"{model.file.name}: a state of {name} gives outputs that are not finite")
    gap = _gaps(outputs["denormals"], outputs["zeros"])
    if not gap <= model.tolerance:
        raise ContractError(f"{model.file.name}: a denormal state differs from a zero one by {gap:.1e}")
    return "finite on states of +-1e4, denormal states equal zero ones"


def _verify_stream(model: Model, frames: NDArray[Any], count: int) -> str:
    """Outputs stay bounded at every one of many steps without resetting the state."""
    for outputs in steps(model, frames, count):
        _bounded(model, f"stream of {count} steps", outputs)
    return f"bounded at every step of a stream of {count}"


def _bounded(model: Model, what: str, outputs: Arrays) -> None:
    for name, value in outputs.items():
        largest = np.abs(value).max()
        if not largest <= LARGEST_OUTPUT:
            raise ContractError(
                f"{model.file.name}: {name} reaches {largest:.3g} on the hard input '{what}', allowed"
                f" {LARGEST_OUTPUT:g} and finite"
            )


def verify_forms(models: list[Model]) -> list[str]:
    """Step and sequence form of one network agree; one line per pair, ContractError if not."""
    lines = []
    for step in (model for model in models if model.card.form == "step"):
        same = [m for m in models if m.card.form == "sequence" and m.card.name == step.card.name]
        for sequence in (m for m in same if m.card.quantisation == step.card.quantisation):
            frames = golden_input(step.card, seed=2)[None]
            gap = _gaps(decide(step, frames), decide(sequence, frames))
            if not gap <= step.tolerance:
                raise ContractError(f"{step.file.name} and {sequence.file.name} differ by {gap:.1e} on golden frames")
            lines.append(f"{step.file.name} = {sequence.file.name} to {gap:.0e}")
    return lines


def _gap(one: NDArray[Any], other: NDArray[Any]) -> float:
    """Largest difference, relative to the output where that exceeds one: a log density reaches hundreds."""
    return float(np.abs(one - other).max() / max(1.0, np.abs(other).max()))


def _gaps(one: Arrays, other: Arrays) -> float:
    return max(_gap(one[name], other[name]) for name in one)
