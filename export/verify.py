"""Checks of released files: card, graph, both forms equal, batches and threads equal, hard inputs bounded."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray

from export.golden import golden_frames, hard_frames
from export.runtime import session
from service.contract import ContractError, ModelCard

TOLERANCE = 1e-5
INT8_TOLERANCE = 2e-2
LARGEST_OUTPUT = 1e4
Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Model:
    """An opened file and its card."""

    file: Path
    card: ModelCard
    run: Any

    @property
    def tolerance(self) -> float:
        """How far two equal computations may differ."""
        return TOLERANCE if self.card.quantisation == "none" else INT8_TOLERANCE

    def __call__(self, inputs: Arrays) -> Arrays:
        """Outputs by name."""
        names = [output.name for output in self.run.get_outputs()]
        return dict(zip(names, self.run.run(names, inputs), strict=True))


def open_model(file: Path, threads: int = 1) -> Model:
    """Open a released file; raise ContractError without a runnable graph, a valid card or the inputs it promises."""
    run = session(file, threads)
    card = ModelCard.from_props(run.get_modelmeta().custom_metadata_map, file.name)
    expected = {"frames"} if card.form == "sequence" else {"frame", "reference", "state"}
    expected |= set(told(card, 1))
    got = {entry.name for entry in run.get_inputs()}
    if got != expected:
        raise ContractError(f"{file.name} takes {sorted(got)}, its card promises {sorted(expected)}")
    return Model(file, card, run)


def told(card: ModelCard, batch: int, gap_width_mm: float = 56.0, grasp_height_mm: float = 30.0) -> Arrays:
    """Gap width and grasp height, each if the network asks for it."""
    said = {"gap_width_mm": gap_width_mm} if card.gap_width_input else {}
    said |= {"grasp_height_mm": grasp_height_mm} if card.grasp_height_input else {}
    return {name: np.full((batch, 1), value, np.float32) for name, value in said.items()}


def run_steps(model: Model, frames: NDArray[np.uint8]) -> Arrays:
    """Run a step model over frames [B, T, 2, H, W, 3], the first one being the reference."""
    state = np.zeros((len(frames), model.card.state_size), np.float32)
    outputs: Arrays = {}
    for step in range(frames.shape[1]):
        fed: Arrays = {"frame": frames[:, step], "reference": frames[:, 0], "state": state}
        outputs = model(fed | told(model.card, len(frames)))
        state = outputs["next_state"]
    return outputs


def decide(model: Model, frames: NDArray[np.uint8]) -> Arrays:
    """The decision of either form on frames [B, T, 2, H, W, 3]."""
    if model.card.form == "step":
        outputs = run_steps(model, frames)
        return {name: value for name, value in outputs.items() if name != "next_state"}
    return model({"frames": frames} | told(model.card, len(frames)))


def verify(folder: Path) -> list[str]:
    """Verify every model of a folder; one line a check, ContractError on the first that fails."""
    files = sorted(folder.glob("*.onnx"))
    if not files:
        raise ContractError(f"no .onnx file in {folder}; export with `python -m export onnx CHECKPOINT`")
    models = [open_model(file) for file in files]
    lines = [f"{model.file.name}: card valid, graph checked" for model in models if _checked(model)]
    for model in models:
        lines += [f"{model.file.name}: {line}" for line in verify_model(model)]
    return lines + _verify_forms(models)


def _checked(model: Model) -> bool:
    onnx.checker.check_model(str(model.file), full_check=True)
    return True


def verify_model(model: Model) -> list[str]:
    """Batch, thread and hard-input checks of one file."""
    card = model.card
    frames = golden_frames(card.frame, card.frames_per_decision)[None]
    alone = decide(model, frames)
    crowd = decide(model, np.repeat(frames, 4, 0))
    batch_gap = max(_gap(alone[name][0], crowd[name][3]) for name in alone)
    threads_gap = _gaps(alone, decide(open_model(model.file, threads=2), frames))
    for what, gap in (("alone and in a batch", batch_gap), ("with one thread and two", threads_gap)):
        if not gap <= model.tolerance:
            raise ContractError(
                f"{model.file.name}: outputs {what} differ by {gap:.1e}, expected {model.tolerance:.0e}"
            )
    for name, hard in hard_frames(card.frame, card.frames_per_decision).items():
        _bounded(model, name, decide(model, hard[None]))
    lines = [f"batch invariant to {batch_gap:.0e}, thread invariant to {threads_gap:.0e}, hard inputs bounded"]
    if card.form == "step":
        lines.append(_verify_stream(model, frames))
    return lines


def _verify_stream(model: Model, frames: NDArray[np.uint8], steps: int = 500) -> str:
    state = np.zeros((1, model.card.state_size), np.float32)
    outputs: Arrays = {}
    for step in range(steps):
        now = frames[:, step % frames.shape[1]]
        fed: Arrays = {"frame": now, "reference": frames[:, 0], "state": state}
        outputs = model(fed | told(model.card, 1))
        state = outputs["next_state"]
    _bounded(model, f"stream of {steps} steps", outputs)
    return f"bounded after a stream of {steps} steps"


def _bounded(model: Model, what: str, outputs: Arrays) -> None:
    for name, value in outputs.items():
        if not (np.isfinite(value).all() and np.abs(value).max() <= LARGEST_OUTPUT):
            raise ContractError(f"{model.file.name}: {name} is not finite and bounded on the hard input '{what}'")


def _verify_forms(models: list[Model]) -> list[str]:
    lines = []
    for step in (model for model in models if model.card.form == "step"):
        same = [m for m in models if m.card.form == "sequence" and m.card.name == step.card.name]
        for sequence in (m for m in same if m.card.quantisation == step.card.quantisation):
            frames = golden_frames(step.card.frame, step.card.frames_per_decision, seed=2)[None]
            gap = _gaps(decide(step, frames), decide(sequence, frames))
            if not gap <= step.tolerance:
                raise ContractError(f"{step.file.name} and {sequence.file.name} differ by {gap:.1e} on golden frames")
            lines.append(f"{step.file.name} = {sequence.file.name} to {gap:.0e}")
    return lines


def _gap(one: NDArray[Any], other: NDArray[Any]) -> float:
    """Largest difference, relative to the output where it exceeds one: a log density reaches hundreds."""
    return float(np.abs(one - other).max() / max(1.0, np.abs(other).max()))


def _gaps(one: Arrays, other: Arrays) -> float:
    return max(_gap(one[name], other[name]) for name in one)
