"""Peers: the same network under torch and OpenVINO, one thread each, from the same released file.

torch gets the weights out of the ONNX file, so no checkpoint is needed and nothing but the runtime differs.
"""

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import onnx

from export.bench.measure import example_inputs
from export.onnx.model import Arrays, Model
from service.contract import ContractError

Peer = Callable[[], Any]
NAMES = ("torch", "openvino")
CLOSE = {"none": 1e-3, "fp16": 1e-2, "int8": 0.2}
"""How far a peer's outputs may be, relative to the largest or one: the same network was computed."""


class PeerAbsentError(ContractError):
    """A peer that cannot run here or cannot run this file; the text says why."""


def known(text: str) -> tuple[str, ...]:
    """Names of peers separated by commas; raises ContractError on an unknown one."""
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    for name in names:
        if name not in NAMES:
            raise ContractError(f"no peer {name}, expected some of {', '.join(NAMES)}")
    return names


def peer(name: str, model: Model) -> Peer:
    """A call of one peer on the model's golden inputs; its outputs were compared first.

    Raises ContractError on an unknown name, PeerAbsentError where the peer cannot run this file.
    """
    (name,) = known(name)
    inputs = example_inputs(model)
    call = {"torch": _torch, "openvino": _openvino}[name](model, inputs)
    _compare(name, model, inputs, call())
    return call


def _compare(name: str, model: Model, inputs: Arrays, got: list[Any]) -> None:
    expected = list(model(inputs).values())
    for ours, theirs in zip(expected, got, strict=True):
        gap = float(np.abs(ours - np.asarray(theirs)).max() / max(1.0, float(np.abs(ours).max())))
        if not gap <= CLOSE[model.card.quantisation]:
            raise PeerAbsentError(f"{name} gives other outputs for {model.file.name}: off by {gap:.1e}")


def _torch(model: Model, inputs: Arrays) -> Peer:
    import torch

    torch.set_num_threads(1)
    network: Any = rebuild(model)
    tensors = {name: torch.from_numpy(value) for name, value in inputs.items()}

    def call() -> list[Any]:
        with torch.inference_mode():
            return [output.numpy() for output in network(**tensors)]

    return call


def rebuild(model: Model) -> Any:
    """The torch module of a released fp32 file, with the weights that it holds.

    Raises PeerAbsentError on an int8 or fp16 build and on the paper's networks.
    """
    import torch

    from training.networks.forms import SequenceForm, StepForm

    if model.card.quantisation != "none":
        raise PeerAbsentError(f"torch has no {model.card.quantisation} build of {model.file.name}")
    stored = {
        tensor.name: torch.from_numpy(onnx.numpy_helper.to_array(tensor).copy())
        for tensor in onnx.load(str(model.file)).graph.initializer
    }
    weights = {name.removeprefix("network."): value for name, value in stored.items() if name.startswith("network.")}
    network = _empty(model, weights)
    names = network.state_dict()
    if "field_scale" not in weights:  # the exporter folds it into the one nameless pair of numbers of the graph
        pairs = [value for value in stored.values() if value.shape == (2,) and value.dtype == torch.float32]
        if len(pairs) == 1:
            weights["field_scale"] = torch.cat([pairs[0], names["field_scale"][2:]])
    try:
        network.load_state_dict(names | {name: value for name, value in weights.items() if name in names})
    except RuntimeError as error:
        raise PeerAbsentError(f"{model.file.name} is of an older architecture; torch cannot rebuild it") from error
    form = SequenceForm if model.card.form == "sequence" else StepForm
    return form(network, model.card.role).eval()


def _empty(model: Model, weights: dict[str, Any]) -> Any:
    from training.networks import build
    from training.networks.settings import NetworkConfig

    front = weights.get("front.cells.weight")
    try:
        settings = NetworkConfig(
            kind="markers" if front is None else "compact",
            front_width=NetworkConfig().front_width if front is None else front.shape[0],
            trunk_width=weights["trunk.convolutions.0.weight"].shape[0],
            feature_size=weights["trunk.project.weight"].shape[0],
            state_size=weights["trunk.cell.weight_hh"].shape[1],
            affine_fit="trunk.affine.read.weight" in weights,
        )
    except KeyError as error:
        raise PeerAbsentError(f"{model.file.name} has no weights named {error}; torch cannot rebuild it") from error
    return build(settings, len(model.card.classes), model.card.profile)


def _openvino(model: Model, inputs: Arrays) -> Peer:
    try:
        import openvino
    except ImportError as error:
        raise PeerAbsentError('openvino is not installed: pip install ".[bench]"') from error
    core = openvino.Core()
    # fp32: on processors with AMX OpenVINO would otherwise compute in bfloat16, which is another network.
    options = {"INFERENCE_NUM_THREADS": "1", "PERFORMANCE_HINT": "LATENCY", "INFERENCE_PRECISION_HINT": "f32"}
    try:
        compiled = core.compile_model(core.read_model(str(model.file)), "CPU", options)
    except RuntimeError as error:
        first = re.sub(r"\s+", " ", str(error))[:160]
        raise PeerAbsentError(f"openvino cannot read {model.file.name}: {first}") from error
    request = compiled.create_infer_request()
    outputs = list(compiled.outputs)

    def call() -> list[Any]:
        request.infer(inputs)
        return [request.get_tensor(output).data for output in outputs]

    return call
