"""Fully connected layers in int8 that read bytes: the input has one scale, found on calibration, a row of weights one.

Such a layer costs what reading its weights costs: the runtime's QGemm multiplies bytes as they come and gives float32.
Rounding the input block by block as it arrives (MatMulNBits) took up to twice as long, most where the weights come from
memory and not from a cache.
"""

from typing import Any

import numpy as np
from onnx import helper, numpy_helper

from export.trunk import MICROSOFT, Bytes, round_rows, scales

LARGE = 2**20
"""Weights of a layer beyond which reading them is what it costs."""


def as_bytes(graph: Any, before: Any, tensor: str, largest: float) -> Bytes:
    """A rectified float32 tensor in bytes, once for all its readers; the first of them is ``before``."""
    made = Bytes(f"{tensor}.bytes", largest / 255, 0)
    if made.name not in {name for node in graph.node for name in node.output}:
        names = [_constant(graph, f"{made.name}.{i}", value) for i, value in enumerate(scales(made))]
        rounding = helper.make_node("QuantizeLinear", [tensor, *names], [made.name], name=made.name)
        graph.node.insert(list(graph.node).index(before), rounding)
    return made


def multiply_bytes(graph: Any, node: Any, weight: Any, given: Bytes) -> None:
    """Put a product of int8 in the place of a Gemm, whose weights are [rows, depth]."""
    bias = next(numpy_helper.to_array(tensor) for tensor in graph.initializer if tensor.name == node.input[2])
    steps, scale = round_rows(numpy_helper.to_array(weight))
    values: list[Any] = [
        *scales(given),
        np.ascontiguousarray(steps.astype(np.int8).T),
        scale.astype(np.float32),
        np.zeros(len(scale), np.int8),
        np.rint(bias / (given.scale * scale)).astype(np.int32),
    ]
    names = [_constant(graph, f"{node.output[0]}.{i}", value) for i, value in enumerate(values)]
    product = helper.make_node("QGemm", [given.name, *names], list(node.output), name=node.name, domain=MICROSOFT)
    place = list(graph.node).index(node)
    graph.node.remove(node)
    graph.node.insert(place, product)


def _constant(graph: Any, name: str, value: Any) -> str:
    graph.initializer.append(numpy_helper.from_array(np.asarray(value), name))
    return name
