"""An opened model file: its card, and a call that checks its inputs."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from export.onnx.runtime import session
from service.contract import ContractError, ModelCard
from service.contract.model_card import Role
from service.contract.self_test import CONDITIONS

OUTPUTS: dict[Role, list[str]] = {
    "direction": ["logits"],
    "magnitude": ["error", "log_sigma"],
    "joint": ["log_density"],
    "pair": ["logits", "error", "log_sigma"],
}
TOLERANCE = 1e-5
INT8_TOLERANCE = 2e-2
KINDS: dict[str, np.dtype[Any]] = {"tensor(uint8)": np.dtype(np.uint8), "tensor(float)": np.dtype(np.float32)}
Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Model:
    """An opened file and its card."""

    file: Path
    card: ModelCard
    run: Any

    @property
    def tolerance(self) -> float:
        """Largest allowed difference of two equal computations."""
        return TOLERANCE if self.card.quantisation == "none" else INT8_TOLERANCE

    @cached_property
    def _names(self) -> list[str]:
        return [output.name for output in self.run.get_outputs()]

    @cached_property
    def _expected(self) -> dict[str, tuple[np.dtype[Any], list[Any]]]:
        return {entry.name: (KINDS[entry.type], list(entry.shape)) for entry in self.run.get_inputs()}

    def __call__(self, inputs: Arrays) -> Arrays:
        """Outputs by name; ContractError on an input that is missing, unknown or of another dtype or shape."""
        if set(inputs) != set(self._expected):
            raise ContractError(f"{self.file.name} was given {sorted(inputs)}, expected {sorted(self._expected)}")
        for name, (kind, shape) in self._expected.items():
            array = inputs[name]
            if array.dtype != kind or array.ndim != len(shape) or array.shape[1:] != tuple(shape[1:]):
                sizes = ", ".join(["B", *map(str, shape[1:])])
                raise ContractError(
                    f"{self.file.name}: {name} is {array.dtype}{list(array.shape)}, expected {kind}[{sizes}]"
                )
        return dict(zip(self._names, self.run.run(self._names, inputs), strict=True))


def open_model(file: Path, threads: int = 1) -> Model:
    """Open a released file; raise ContractError without a runnable graph, a valid card or its stated inputs."""
    run = session(file, threads)
    card = ModelCard.from_props(run.get_modelmeta().custom_metadata_map, file.name)
    expected = {"frames"} if card.form == "sequence" else {"frame", "reference", "state"}
    expected |= set(geometry_inputs(card, 1))
    got = {entry.name for entry in run.get_inputs()}
    if got != expected:
        raise ContractError(f"{file.name} takes {sorted(got)}, its card promises {sorted(expected)}")
    given = {entry.name for entry in run.get_outputs()}
    promised = {name for name in OUTPUTS[card.role] if card.has_sigma or name != "log_sigma"}
    if not promised <= given:
        raise ContractError(f"{file.name} gives {sorted(given)}, its card promises {sorted(promised)}")
    return Model(file, card, run)


def steps(model: Model, frames: NDArray[Any], count: int, geometry: Arrays | None = None) -> Iterator[Arrays]:
    """Outputs of a step model after each of ``count`` steps from a zero state.

    ``frames`` [B, T, 2, ...] repeat cyclically, the first is the reference; ``geometry``: the default one unless given.
    """
    state = np.zeros((len(frames), model.card.state_size), np.float32)
    conditions = geometry_inputs(model.card, len(frames)) if geometry is None else geometry
    for step in range(count):
        inputs: Arrays = {"frame": frames[:, step % frames.shape[1]], "reference": frames[:, 0], "state": state}
        outputs = model(inputs | conditions)
        state = outputs["next_state"]
        yield outputs


def geometry_inputs(card: ModelCard, batch: int, gap_width_mm: float = 56.0, grasp_height_mm: float = 30.0) -> Arrays:
    """Gap width and grasp height, float32 [batch, 1] each, and other conditions, as far as the network reads them."""
    geometry = {"gap_width_mm": gap_width_mm} if card.gap_width_input else {}
    geometry |= {"grasp_height_mm": grasp_height_mm} if card.grasp_height_input else {}
    inputs: Arrays = {name: np.full((batch, 1), value, np.float32) for name, value in geometry.items()}
    if card.pressing:
        conditions = (gap_width_mm, grasp_height_mm, *CONDITIONS[2:])
        inputs["conditions"] = np.tile(np.array(conditions, np.float32), (batch, 1))
    return inputs
