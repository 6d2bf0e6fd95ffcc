"""fp32 -> int8 and fp16, judged by the robot commands they would change (:mod:`export.tradeoff.agreement`).

Every weight is stored as int8, in blocks (:mod:`export.blocks`). What is computed in int8, too, is what pays: AlexNet's
convolutions (:mod:`export.trunk`) and the fully connected layers after them (:mod:`export.dense`), whose inputs have
one scale each, found on calibration decisions; if asked for, other fully connected and recurrent layers of some size,
whose inputs are rounded as they come. Outputs and states stay fp32: 256 steps over an output's range are coarser than
the commands that follow may differ.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
from numpy.typing import NDArray
from onnx import helper, numpy_helper
from rich.progress import track

from export.blocks import SMALL_BLOCK, WORTH_A_PRODUCT, block_of, multiply, round_weights, store
from export.dense import LARGE, as_bytes, multiply_bytes
from export.onnx.decisions import Decision
from export.onnx.model import Arrays, Model, open_model, told
from export.onnx.to_onnx import attach_card
from export.trunk import MICROSOFT, Trunk, drop_unread, find_trunk, replace_trunk
from service.contract import ContractError

LAYERS = ("Conv", "Gemm")
CALIBRATION_DECISIONS = 96
LARGE_CALIBRATION = 16
"""Of a network with large layers: their weights go to the nearest step, so that only ranges are looked at."""
LARGE_BYTES = 50_000_000
FAR_OFF = 0.25
"""Of the outputs' size: an int8 build that is further off than this computes something else."""
SMALLEST_FP16 = 256
"""Smaller weights stay fp32: nothing to gain."""


@dataclass
class _Seen:
    """What calibration saw: second moments of a layer's inputs by node, greatest magnitude by tensor."""

    moments: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    largest: dict[str, float] = field(default_factory=dict)
    greys: float = 0.0
    """Greatest difference of a frame's bytes from the reference's."""


def quantize(file: Path, out: Path, decisions: Sequence[Decision], *, dynamic: bool = False) -> Path:
    """Write the int8 twin of a released model; ``decisions`` are real ones to calibrate on.

    ``dynamic`` multiplies fully connected and recurrent layers of some size in int8, too, not only AlexNet's.
    Raises ContractError if the file is not an fp32 release in step form or the build computes something else on this
    processor.
    """
    model = open_model(file)
    if model.card.quantisation != "none" or model.card.form != "step":
        what = f"{model.card.form}, {model.card.quantisation}"
        raise ContractError(f"{file.name} is already int8 or no step ({what}), expected an fp32 step release")
    graph = onnx.load(str(file))
    weights = {tensor.name: tensor for tensor in graph.graph.initializer}
    trunk = find_trunk(graph.graph)
    inside = {stage.convolution.name for stage in trunk.stages} if trunk else set()
    layers = [n for n in graph.graph.node if n.op_type in LAYERS and n.input[1] in weights and n.name not in inside]
    if not layers and trunk is None:
        raise ContractError(f"{file.name} holds no layer with weights")
    if file.stat().st_size > LARGE_BYTES:
        decisions = decisions[:: max(1, len(decisions) // LARGE_CALIBRATION)]
    dense = [node for node in layers if trunk and _large(weights[node.input[1]])]
    layers = [node for node in layers if node not in dense]
    found = _look(model, graph, layers, trunk, dense, decisions)
    if trunk:
        _shrink_trunk(graph.graph, trunk, dense, found)
    weights = {tensor.name: tensor for tensor in graph.graph.initializer}
    for layer in layers:
        _shrink(graph.graph, layer, weights, found.moments.get(layer.name), dynamic=dynamic)
    _stamp(graph)
    out.parent.mkdir(parents=True, exist_ok=True)
    onnx.save(graph, str(out))
    attach_card(out, model.card.model_copy(update={"quantisation": "int8", "self_test": None}))
    _self_test(model, open_model(out), decisions[:2])
    return out


def _large(weight: Any) -> bool:
    return int(np.prod(weight.dims)) >= LARGE


def _shrink_trunk(graph: Any, trunk: Trunk, dense: list[Any], found: _Seen) -> None:
    """AlexNet's convolutions and the large layers after them, all of which read rectified features."""
    flat = replace_trunk(graph, trunk, found.largest, found.greys)
    weights = {tensor.name: tensor for tensor in graph.initializer}
    for node in dense:
        read = node.input[0]
        given = flat if read == trunk.flat else as_bytes(graph, node, read, found.largest[read])
        multiply_bytes(graph, node, weights[node.input[1]], given)
    drop_unread(graph)


def _shrink(
    graph: Any, layer: Any, weights: dict[str, Any], moments: NDArray[np.float64] | None, *, dynamic: bool
) -> None:
    """One layer's weights in int8; a weight that several layers read is stored by the first."""
    name = layer.input[1]
    if f"{name}.shape" in {tensor.name for tensor in graph.initializer}:
        return
    stored = weights[name]
    values = numpy_helper.to_array(stored)
    rows = values.reshape(len(values), -1)
    shared = sum(name in node.input for node in graph.node) > 1
    multiplied = dynamic and rows.size >= WORTH_A_PRODUCT
    if layer.op_type == "Gemm" and multiplied and not shared:
        multiply(graph, layer, stored, round_weights(rows, moments, SMALL_BLOCK))
    else:
        store(graph, layer, stored, round_weights(rows, moments, block_of(rows.shape[1])))


def _stamp(graph: Any) -> None:
    """Name the runtime's own operators, if any is used."""
    if any(node.domain == MICROSOFT for node in graph.graph.node):
        graph.opset_import.append(helper.make_opsetid(MICROSOFT, 1))


def _look(
    model: Model, graph: Any, layers: list[Any], trunk: Trunk | None, dense: list[Any], decisions: Sequence[Decision]
) -> _Seen:
    """Run the fp32 network over the decisions and look at the inputs of its layers."""
    found = _Seen()
    ranged = [trunk.images, *(stage.rectified for stage in trunk.stages)] if trunk else []
    ranged += [node.input[0] for node in dense]
    shapes = {tensor.name: tuple(tensor.dims) for tensor in graph.graph.initializer}
    given = {entry.name for entry in graph.graph.input}
    names = list(dict.fromkeys([*ranged, *(layer.input[0] for layer in layers if layer.input[0] not in given)]))
    run = _watching(graph, names)
    for fed in track(list(feeds(model, decisions)), description=f"calibrating {model.file.name}", transient=True):
        seen = dict(zip(names, run.run(names, fed), strict=True)) | fed
        if trunk:
            change = fed["frame"].astype(np.int16) - fed["reference"]
            found.greys = max(found.greys, float(np.abs(change).max()))
        for node in dense:
            if not seen[node.input[0]].min() >= 0:
                raise ContractError(f"{node.name} of {model.file.name} reads {node.input[0]}, which is not rectified")
        for name in ranged:
            found.largest[name] = max(found.largest.get(name, 1e-6), float(np.abs(seen[name]).max()))
        for layer in layers:
            rows = _rows(layer, seen[layer.input[0]], shapes[layer.input[1]])
            found.moments[layer.name] = found.moments.get(layer.name, 0.0) + (rows.T @ rows).astype(np.float64)
    return found


def _watching(graph: Any, names: list[str]) -> Any:
    """A session of the graph that also gives these tensors."""
    watched = onnx.ModelProto()
    watched.CopyFrom(graph)
    known = {output.name for output in watched.graph.output}
    watched.graph.output.extend(onnx.ValueInfoProto(name=name) for name in names if name not in known)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.log_severity_level = 3
    return onnxruntime.InferenceSession(watched.SerializeToString(), options, providers=["CPUExecutionProvider"])


def _rows(layer: Any, given: NDArray[np.float32], shape: tuple[int, ...]) -> NDArray[np.float32]:
    """What a layer multiplies by its weights, one row a product: a convolution's patches."""
    if layer.op_type == "Gemm":
        return given
    known = {a.name: helper.get_attribute_value(a) for a in layer.attribute}
    top, left, bottom, right = known.get("pads", [0, 0, 0, 0])
    stride_v, stride_u = known.get("strides", [1, 1])
    padded = np.pad(given, ((0, 0), (0, 0), (top, bottom), (left, right)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, shape[2:], (2, 3))[:, :, ::stride_v, ::stride_u]
    return windows.transpose(0, 2, 3, 1, 4, 5).reshape(-1, int(np.prod(shape[1:])))


def feeds(model: Model, decisions: Sequence[Decision]) -> Iterator[Arrays]:
    """Every step of every decision, with the state it would see."""
    for decision in decisions:
        frames = decision.seen_by(model.card)
        state = np.zeros((1, model.card.state_size), np.float32)
        for frame in frames:
            fed: Arrays = {"frame": frame[None], "reference": frames[:1], "state": state}
            fed |= told(model.card, 1, decision.gap_width_mm, decision.grasp_height_mm)
            yield fed
            state = model(fed)["next_state"]


def _self_test(model: Model, small: Model, decisions: Sequence[Decision]) -> None:
    """Refuse a build whose outputs are far off: saturation shows as errors of the size of the outputs."""
    apart, size = dict[str, float](), dict[str, float]()
    for fed in feeds(model, decisions):
        wanted, got = model(fed), small(fed)
        for name, value in wanted.items():
            apart[name] = apart.get(name, 0.0) + float(np.abs(value - got[name]).mean())
            size[name] = size.get(name, 0.0) + float(np.abs(value).mean())
    for name, total in apart.items():
        gap = total / max(size[name], 1e-6)
        if not gap < FAR_OFF:
            raise ContractError(
                f"{small.file.name}: {name} is off by {100 * gap:.0f} % of its size; int8 saturates here"
            )


def store_fp16(file: Path, out: Path) -> Path:
    """Write the twin whose weights are stored in fp16 and widened on loading: half the file, the same speed.

    Raises ContractError if the file is not an fp32 release or a weight does not fit fp16.
    """
    source = open_model(file)
    if source.card.quantisation != "none":
        raise ContractError(f"{file.name} is already {source.card.quantisation}, expected an fp32 release")
    graph = onnx.load(str(file))
    widened = []
    for tensor in graph.graph.initializer:
        values = onnx.numpy_helper.to_array(tensor)
        if values.dtype != np.float32 or values.size < SMALLEST_FP16:
            continue
        if not np.abs(values).max() < np.finfo(np.float16).max:
            raise ContractError(f"{file.name}: the weights {tensor.name} do not fit fp16")
        name = tensor.name
        tensor.CopyFrom(onnx.numpy_helper.from_array(values.astype(np.float16), f"{name}.fp16"))
        widened.append(onnx.helper.make_node("Cast", [f"{name}.fp16"], [name], to=onnx.TensorProto.FLOAT))
    nodes = [*widened, *graph.graph.node]
    del graph.graph.node[:]
    graph.graph.node.extend(nodes)
    out.parent.mkdir(parents=True, exist_ok=True)
    onnx.save(graph, str(out))
    onnx.checker.check_model(str(out), full_check=True)
    attach_card(out, source.card.model_copy(update={"quantisation": "fp16", "self_test": None}))
    return out
