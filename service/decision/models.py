"""The service's deciding networks: ONNX files whose cards are valid and agree, each warmed up before use."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from service.contract import ContractError, ModelCard
from service.contract.model_card import CONDITIONS, UNTRAINED
from service.contract.self_test import check_self_test
from service.contract.wire import ModelEntry

Array = NDArray[Any]
_OUTPUTS = {
    "direction": {"logits"},
    "magnitude": {"error"},
    "joint": {"log_density"},
    "pair": {"logits", "error"},
}
_DECIDING = ({"direction", "magnitude"}, {"joint"}, {"pair"})
_WARM_UP_STEPS = 3


class ModelError(ContractError):
    """A model cannot serve; the text names the file and the remedy."""


@dataclass(frozen=True, slots=True)
class LoadedModel:
    """One ONNX file, open in onnxruntime with one thread, and its card.

    In step form it maps one frame pair and its own recurrent state to outputs and the next state.
    """

    path: Path
    card: ModelCard
    sha256: str
    session: Any
    inputs: tuple[Any, ...] = field(init=False, repr=False)
    outputs: tuple[Any, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Read the session's inputs and outputs once: each query builds the descriptions anew."""
        object.__setattr__(self, "inputs", tuple(self.session.get_inputs()))
        object.__setattr__(self, "outputs", tuple(self.session.get_outputs()))

    @property
    def entry(self) -> ModelEntry:
        return ModelEntry(card=self.card, sha256=self.sha256)

    def run(self, inputs: Mapping[str, Array]) -> dict[str, Array]:
        """All outputs by name for a batch of inputs that match the card's shapes."""
        names = [output.name for output in self.outputs]
        return dict(zip(names, self.session.run(names, dict(inputs)), strict=True))

    def fresh_state(self) -> NDArray[np.float32]:
        """Zeros float32 [1, state_size]: the state before the first frame of a decision."""
        return np.zeros((1, self.card.state_size), np.float32)

    def step(
        self,
        frame: Array,
        reference: Array,
        state: NDArray[np.float32],
        gap_width_mm: float,
        grasp_height_mm: float | None = None,
        conditions: Mapping[str, float | None] = MappingProxyType({}),
    ) -> tuple[dict[str, Array], NDArray[np.float32]]:
        """Outputs after one pair; ``frame`` and ``reference`` are [2, *card.input_shape], left finger first.

        ``conditions`` are by name, for a network that reads steps of depth.
        """
        inputs: dict[str, Array] = {"frame": frame[None], "reference": reference[None], "state": state}
        if self.card.gap_width_input:
            inputs["gap_width_mm"] = np.array([[gap_width_mm]], np.float32)
        if self.card.grasp_height_input:
            inputs["grasp_height_mm"] = np.array([[grasp_height_mm or 0.0]], np.float32)
        if self.card.pressing:
            inputs["conditions"] = np.array([[conditions.get(name) or 0.0 for name in CONDITIONS]], np.float32)
        outputs = self.run(inputs)
        return outputs, outputs.pop("next_state")

    def warm_up(self) -> dict[str, Array]:
        """Run a few steps on zeros, so that the first real decision is as fast as the later ones; the last outputs."""
        still = np.zeros((2, *self.card.input_shape), self.card.input_dtype)
        state = self.fresh_state()
        for _ in range(_WARM_UP_STEPS):
            outputs, state = self.step(still, still, state, 50.0)
        return outputs


@dataclass(frozen=True, slots=True)
class ModelSet:
    """The deciding networks (direction and magnitude, both in one graph, or a joint density), and every file found."""

    steps: tuple[LoadedModel, ...]
    models: tuple[LoadedModel, ...]

    @property
    def card(self) -> ModelCard:
        """The card whose shared fields (frame, frames per decision, thresholds, reference rule) all steps agree on."""
        return self.steps[0].card

    @property
    def entries(self) -> tuple[ModelEntry, ...]:
        return tuple(step.entry for step in self.steps)

    @property
    def folder(self) -> Path:
        """Where they were loaded from."""
        return self.models[0].path.absolute().parent

    @property
    def cautions(self) -> tuple[str, ...]:
        """What a person should know of networks that may decide all the same, a sentence each."""
        cards = [step.card for step in self.steps]
        cautions = [f"{card.name} is untrained: {why}" for card in cards if (why := card.training_run.get(UNTRAINED))]
        if len({(card.training_data_sha256, json.dumps(card.training_run, sort_keys=True)) for card in cards}) > 1:
            names = " and ".join(card.name for card in cards)
            cautions.append(f"{names} are from different trainings: no figure of either was measured with the other")
        return tuple(cautions)


def load_model(path: Path) -> LoadedModel:
    """Open, check and warm up one ONNX file; raise ModelError if it is unreadable, lacks a card, or contradicts it."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.log_severity_level = 4
    content = path.read_bytes()
    try:
        session = ort.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise ModelError(
            f"{path} is not a readable ONNX model; export it again with `python -m export onnx`"
        ) from error
    card = ModelCard.from_props(session.get_modelmeta().custom_metadata_map, str(path))
    model = LoadedModel(path, card, hashlib.sha256(content).hexdigest(), session)
    _check_graph(model)
    try:
        check_self_test(card, model.run, str(path))
        if card.form == "step":
            _check_widths(model, model.warm_up())
    except ContractError as error:
        raise ModelError(str(error)) from error
    except Exception as error:
        why = " ".join(str(error).split())  # the numbers are in its later lines
        raise ModelError(f"{path} does not run as its card says: {why}") from error
    return model


def _check_graph(model: LoadedModel) -> None:
    card = model.card
    shape = [2, *card.input_shape]
    if card.form == "step":
        expected: dict[str, list[int]] = {"frame": shape, "reference": shape, "state": [card.state_size]}
    else:
        expected = {"frames": [card.frames_per_decision, *shape]}
    if card.gap_width_input:
        expected["gap_width_mm"] = [1]
    if card.grasp_height_input:
        expected["grasp_height_mm"] = [1]
    if card.pressing:
        expected["conditions"] = [len(CONDITIONS)]
    inputs = {entry.name: list(entry.shape[1:]) for entry in model.inputs}
    if inputs != expected:
        raise ModelError(f"{model.path} takes inputs {inputs}, but its card says {expected}; export it again")
    outputs = {entry.name for entry in model.outputs}
    needed = _OUTPUTS[card.role] | ({"log_sigma"} if card.has_sigma else set())
    needed |= {"strangeness"} if card.pressing and card.pressing.strangeness_limit else set()
    needed |= {"next_state"} if card.form == "step" else set()
    if not needed <= outputs:
        raise ModelError(f"{model.path} gives outputs {sorted(outputs)}, but its card promises {sorted(needed)}")


def _check_widths(model: LoadedModel, outputs: Mapping[str, Array]) -> None:
    card, grid = model.card, (len(model.card.grid_x_mm), len(model.card.grid_theta_deg))
    promised = {"logits": (len(card.classes),), "error": (2,), "log_sigma": (2,), "log_density": grid}
    for name in _OUTPUTS[card.role] | ({"log_sigma"} if card.has_sigma else set()):
        if outputs[name].shape != (1, *promised[name]):
            given = f"{model.path} gives {name} of {list(outputs[name].shape[1:])}"
            raise ModelError(f"{given}, but its card promises {list(promised[name])}; export it again")


def load_models(folder: Path) -> ModelSet:
    """Load, check and warm up all ``*.onnx`` of a folder.

    Raises ModelError (one line with the remedy) when the folder or a needed network is missing, a card is absent or
    invalid, a role is served twice, or two cards disagree.
    """
    folder = Path(folder)
    paths = sorted(folder.glob("*.onnx"))
    if not paths:
        raise ModelError(f"no *.onnx model in {folder}; export them with `python -m export onnx` or pass --models DIR")
    models = tuple(load_model(path) for path in paths)
    steps = _choose_steps(folder, [model for model in models if model.card.form == "step"])
    _check_agreement(steps)
    return ModelSet(steps, models)


def _choose_steps(folder: Path, candidates: Sequence[LoadedModel]) -> tuple[LoadedModel, ...]:
    by_role: dict[str, LoadedModel] = {}
    for model in candidates:
        other = by_role.setdefault(model.card.role, model)
        if other is not model:
            raise ModelError(f"two {model.card.role} step models, {other.path.name} and {model.path.name}; keep one")
    for whole in {"joint", "pair"} & set(by_role):
        if set(by_role) != {whole}:
            raise ModelError(
                f"{folder} holds a {whole} step model beside {sorted(by_role)}; keep the {whole} one or the others"
            )
    if set(by_role) not in _DECIDING:
        missing = " and ".join(sorted({"direction", "magnitude"} - set(by_role)))
        raise ModelError(f"{folder} has no {missing} step model; export it with `python -m export onnx`")
    return tuple(by_role[role] for role in sorted(by_role))


def _check_agreement(steps: Sequence[LoadedModel]) -> None:
    first, *others = steps
    for other in others:
        disagreements = first.card.disagreements(other.card)
        if disagreements:
            raise ModelError(
                f"{first.path.name} and {other.path.name} disagree on {'; '.join(disagreements)};"
                " export both from the same training run"
            )
