"""AlexNet's convolutions in int8, from the camera's bytes on, laid out as this runtime's kernels are fastest.

The difference of the frames is rounded to bytes. Resize and change of colour order are linear: 10 x 10 px of it give
7 x 7 px, so that one strided convolution does both. What follows stays in uint8 with channels last; a rectified output
is one whose zero point is zero, so no layer of its own rectifies, and every activation is rounded once. The flat
features stay bytes, too: the fully connected layers multiply them as they are (:mod:`export.dense`).

Weights carry a zero point of one. A convolution of symmetric weights goes to a kernel that knows no matrix unit
(AMX); any other is gathered and given to the product that does, in half the time where there is one (a processor
without may be faster with zero: it was not at hand).
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from service.contract import ContractError, Sensor
from training.networks.alexnet import FEATURES, IMAGENET_SPREAD, INPUT_PX

MICROSOFT = "com.microsoft"
FIRST_WEIGHT = "alexnet.features.0.weight"
GIVEN_PX, MADE_PX = 10, 7
"""320 px become 224: ten become seven, with no pixel shared between groups."""
HEIGHT_PX = Sensor.load().height_px
MARGIN_PX = (Sensor.load().width_px - HEIGHT_PX) // 2
CELLS = HEIGHT_PX // GIVEN_PX
WEIGHT_ZERO = 1
MIDDLE = 128
REACH, CAREFUL_REACH = 126, 63
"""Largest step of a weight; the lower where 16 bits saturate."""


@dataclass(frozen=True)
class Bytes:
    """A uint8 tensor: a value is (stored - zero) * scale."""

    name: str
    scale: float
    zero: int


@dataclass(frozen=True)
class Stage:
    """One convolution, the name of its rectified output, and whether a pooling follows."""

    convolution: Any
    rectified: str
    pooled: bool


@dataclass(frozen=True)
class Trunk:
    """The convolutions of a graph, the images they read and the flat features [2 B, 9216] they end in."""

    images: str
    stages: tuple[Stage, ...]
    flat: str


def find_trunk(graph: Any) -> Trunk | None:
    """AlexNet's convolutions in a graph, or None; ContractError if anything unknown stands between them."""
    node = next((n for n in graph.node if n.op_type == "Conv" and n.input[1].endswith(FIRST_WEIGHT)), None)
    if node is None:
        return None
    images, stages = node.input[0], []
    while node.op_type == "Conv":
        rectified = _follower(graph, node, "Relu")
        following = _follower(graph, rectified, "MaxPool", "Conv", "Reshape")
        pooled = following.op_type == "MaxPool"
        stages.append(Stage(node, rectified.output[0], pooled))
        node = _follower(graph, following, "Conv", "Reshape") if pooled else following
    return Trunk(images, tuple(stages), node.output[0])


def _follower(graph: Any, node: Any, *kinds: str) -> Any:
    followers = [other for other in graph.node if node.output[0] in other.input]
    if len(followers) != 1 or followers[0].op_type not in kinds:
        found = [other.op_type for other in followers]
        raise ContractError(f"AlexNet's {node.op_type} is followed by {found}, expected one of {list(kinds)}")
    return followers[0]


def replace_trunk(graph: Any, trunk: Trunk, largest: dict[str, float], greys: float) -> Bytes:
    """Put the int8 convolutions in place of the fp32 ones; returns the flat features.

    ``largest`` is the greatest magnitude seen by tensor name, ``greys`` that of the frames' difference. The flat
    features come out with channels last: the layers that read them get their columns in that order.
    """
    weights = {tensor.name: tensor for tensor in graph.initializer}
    builder = _Builder()
    quantised = builder.images(max(1.0, greys / (MIDDLE - 1)), largest[trunk.images] / (MIDDLE - 1))
    for stage in trunk.stages:
        weight, bias = (numpy_helper.to_array(weights[name]) for name in stage.convolution.input[1:3])
        quantised = builder.convolve(quantised, stage, (weight, bias), largest[stage.rectified] / 255)
    flat = builder.flatten(quantised, trunk.flat)
    channels = len(bias)
    for node in graph.node:
        if node.op_type == "Gemm" and node.input[0] == trunk.flat:
            _channels_last(weights[node.input[1]], channels)
    kept = [node for node in graph.node if node.output[0] != trunk.flat]
    del graph.node[:]
    graph.node.extend(_needed([*builder.nodes, *kept], {output.name for output in graph.output}))
    graph.initializer.extend(builder.constants)
    drop_unread(graph)
    return flat


def _channels_last(weight: Any, channels: int) -> None:
    rows = numpy_helper.to_array(weight)
    turned = rows.reshape(len(rows), channels, -1).transpose(0, 2, 1).reshape(rows.shape)
    weight.CopyFrom(numpy_helper.from_array(np.ascontiguousarray(turned), weight.name))


def _needed(nodes: list[Any], outputs: set[str]) -> list[Any]:
    """Nodes that an output depends on, in order."""
    wanted, kept = set(outputs), []
    for node in reversed(nodes):
        if wanted & set(node.output):
            wanted |= set(node.input)
            kept.append(node)
    return kept[::-1]


def drop_unread(graph: Any) -> None:
    """Forget weights that no node reads any more."""
    read = {name for node in graph.node for name in node.input}
    kept = [tensor for tensor in graph.initializer if tensor.name in read]
    del graph.initializer[:]
    graph.initializer.extend(kept)
    del graph.value_info[:]


class _Builder:
    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def _constant(self, name: str, value: Any) -> str:
        self.constants.append(numpy_helper.from_array(np.asarray(value), f"trunk.{name}"))
        return f"trunk.{name}"

    def _add(self, kind: str, given: list[str], made: str, **attributes: Any) -> str:
        self.nodes.append(helper.make_node(kind, given, [made], name=f"trunk.{made}", **attributes))
        return made

    def images(self, grey: float, scale: float) -> Bytes:
        """Both fingers' difference images uint8 [2 B, 224, 224, 3] (RGB) of ``frame`` and ``reference``.

        A step of the difference is ``grey`` grey levels; it is the sum of frame and reference in steps of minus one.
        """
        steps = [np.float32(1), np.uint8(0), np.float32(-1), np.uint8(0), np.float32(grey), np.uint8(MIDDLE)]
        ours, ours_zero, theirs, theirs_zero, *made = (self._constant(f"change.{i}", v) for i, v in enumerate(steps))
        given = ["frame", ours, ours_zero, "reference", theirs, theirs_zero, *made]
        self._add("QLinearAdd", given, "change", domain=MICROSOFT)
        columns = (("start", MARGIN_PX), ("end", MARGIN_PX + HEIGHT_PX), ("axis", 3))
        self._add("Slice", ["change", *(self._constant(name, [value]) for name, value in columns)], "square")
        shape = self._constant("both", np.array([-1, HEIGHT_PX, HEIGHT_PX, 3]))
        both = Bytes(self._add("Reshape", ["square", shape], "both"), grey, MIDDLE)
        cells = Bytes("cells", scale, MIDDLE)
        self._convolution(both, cells, resizing_weights(), None, 0, strides=[GIVEN_PX, GIVEN_PX])
        split = self._constant("cells.split", np.array([-1, CELLS, CELLS, MADE_PX, 3 * MADE_PX]))
        turned = self._add(
            "Transpose", [self._add("Reshape", ["cells", split], "cells.5")], "turned", perm=[0, 1, 3, 2, 4]
        )
        shape = self._constant("images", np.array([-1, INPUT_PX, INPUT_PX, 3]))
        return Bytes(self._add("Reshape", [turned, shape], "images"), scale, MIDDLE)

    def convolve(self, given: Bytes, stage: Stage, weights: tuple[NDArray[Any], NDArray[Any]], scale: float) -> Bytes:
        """A rectified convolution and its pooling; the weights [out, in, k, k] are those of the fp32 layer."""
        node = stage.convolution
        attributes = {a.name: helper.get_attribute_value(a) for a in node.attribute}
        known = {name: attributes[name] for name in ("strides", "pads") if name in attributes}
        made = Bytes(node.output[0], scale, 0)
        self._convolution(given, made, *weights, WEIGHT_ZERO, **known)
        if not stage.pooled:
            return made
        pooled = f"{made.name}.pooled"
        self._add("NhwcMaxPool", [made.name], pooled, domain=MICROSOFT, kernel_shape=[3, 3], strides=[2, 2])
        return Bytes(pooled, scale, 0)

    def flatten(self, given: Bytes, flat: str) -> Bytes:
        """Features [2 B, 9216], and in float32 under the name ``flat`` for a layer that does not read bytes."""
        made = f"{flat}.bytes"
        self._add("Reshape", [given.name, self._constant("flat", np.array([-1, FEATURES]))], made)
        scale, zero = (self._constant(f"flat.{i}", value) for i, value in enumerate(scales(given)))
        self._add("DequantizeLinear", [made, scale, zero], flat)
        return Bytes(made, given.scale, given.zero)

    def _convolution(
        self,
        given: Bytes,
        made: Bytes,
        weight: NDArray[Any],
        bias: NDArray[Any] | None,
        zero: int,
        **attributes: Any,
    ) -> None:
        rows = len(weight)
        steps, scale = round_rows(weight)
        offsets = np.zeros(rows) if bias is None else bias / (given.scale * scale)
        values: list[Any] = [
            *scales(given),
            (steps + zero).astype(np.int8),
            scale.astype(np.float32),
            np.full(rows, zero, np.int8),
            *scales(made),
            np.rint(offsets).astype(np.int32),
        ]
        constants = [self._constant(f"{made.name}.{place}", value) for place, value in enumerate(values)]
        size = list(weight.shape[2:])
        self._add(
            "QLinearConv",
            [given.name, *constants],
            made.name,
            domain=MICROSOFT,
            channels_last=1,
            kernel_shape=size,
            **attributes,
        )


def scales(tensor: Bytes) -> tuple[np.float32, np.uint8]:
    """Scale and zero point as the runtime takes them."""
    return np.float32(tensor.scale), np.uint8(tensor.zero)


def round_rows(weight: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weights [rows, ...] as steps of one scale a row: steps of the same shape, scales [rows]."""
    rows = weight.reshape(len(weight), -1).astype(np.float64)
    reach = CAREFUL_REACH if saturates() else REACH
    scale = np.maximum(np.abs(rows).max(1), 1e-12) / reach
    return np.rint(rows / scale[:, None]).reshape(weight.shape), scale


def resizing_weights() -> NDArray[np.float64]:
    """Weights [7 * 7 * 3, 3, 10, 10] from differences in grey levels to the normalised difference image.

    Bilinear with half-pixel centres, as ``interpolate(..., align_corners=False)`` has it; channels BGR to RGB.
    """
    share = np.zeros((MADE_PX, GIVEN_PX))
    for made in range(MADE_PX):
        place = (made + 0.5) * GIVEN_PX / MADE_PX - 0.5
        low = int(place)
        share[made, low] += 1 - (place - low)
        share[made, low + 1] += place - low
    each = np.einsum("ia,jb->ijab", share, share) / (255.0 * IMAGENET_SPREAD)
    weight = np.zeros((MADE_PX, MADE_PX, 3, 3, GIVEN_PX, GIVEN_PX))
    for channel in range(3):
        weight[:, :, channel, 2 - channel] = each
    return weight.reshape(MADE_PX * MADE_PX * 3, 3, GIVEN_PX, GIVEN_PX)


@lru_cache(maxsize=1)
def saturates() -> bool:
    """Whether this processor's int8 products saturate in 16 bits: two of the largest are added and looked at."""
    values = {"b": np.full((64, 16), 127, np.int8)}
    graph = helper.make_graph(
        [helper.make_node("MatMulInteger", ["a", "b"], ["c"])],
        "saturation",
        [helper.make_tensor_value_info("a", TensorProto.UINT8, [1, 64])],
        [helper.make_tensor_value_info("c", TensorProto.INT32, [1, 16])],
        [numpy_helper.from_array(value, name) for name, value in values.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    run = onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
    (made,) = run.run(None, {"a": np.full((1, 64), 255, np.uint8)})
    return bool((made != 64 * 255 * 127).any())
