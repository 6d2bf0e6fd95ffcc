"""Weights as int8 in blocks, rounded so that a layer's outputs change least on what it really reads.

A block of weights of one row shares a scale, so that one large weight does not coarsen the others. Rounding follows
Frantar et al. 2023 (GPTQ): the error of each rounded column is made up for by the columns still to come, as far as the
inputs of the layer, seen on calibration decisions, go together.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

BLOCK, SMALL_BLOCK = 32, 16
"""Weights that share a scale where they are widened on loading, and where a layer is multiplied."""
WORTH_A_PRODUCT = 2**14
"""Weights of a layer below which int8 saves no time and only costs accuracy: heads, and a fit of few numbers."""
DAMPING = 0.01
"""Of the mean of the inputs' second moments, so that directions never seen are left alone."""
REACH = 127
ACCUMULATE_INT8 = 4
"""``accuracy_level`` of MatMulNBits: inputs are rounded to int8, block by block, when they arrive."""


@dataclass(frozen=True)
class Blocks:
    """Int8 ``steps`` [rows, depth] and ``scale`` float32 [rows, blocks]: a weight is its step times its scale."""

    steps: NDArray[np.int8]
    scale: NDArray[np.float32]
    block: int


def round_weights(weight: NDArray[Any], moments: NDArray[np.float64] | None, block: int) -> Blocks:
    """Weights [rows, depth] in blocks along the depth.

    ``moments`` float64 [depth, depth] are the layer's inputs' second moments, summed; without them each weight goes to
    its nearest step.
    """
    rows, depth = weight.shape
    left = weight.astype(np.float64)
    carry = None if moments is None else _carry(moments)
    steps = np.empty((rows, depth), np.int8)
    scales = []
    for start in range(0, depth, block):
        part = slice(start, min(start + block, depth))
        scale = np.maximum(np.abs(left[:, part]).max(1) / REACH, 1e-12)
        scales.append(scale)
        if carry is None:
            steps[:, part] = np.clip(np.rint(left[:, part] / scale[:, None]), -REACH, REACH)
            continue
        for column in range(part.start, part.stop):
            rounded = np.clip(np.rint(left[:, column] / scale), -REACH, REACH)
            steps[:, column] = rounded
            error = (left[:, column] - rounded * scale) / carry[column, column]
            left[:, column + 1 :] -= error[:, None] * carry[column, column + 1 :]
    return Blocks(steps, np.stack(scales, 1).astype(np.float32), block)


def _carry(moments: NDArray[np.float64]) -> NDArray[np.float64]:
    """Upper Cholesky factor of the inverse moments: how a column's error is shared among those that follow."""
    damped = moments + (DAMPING * float(np.diag(moments).mean()) + 1e-12) * np.eye(len(moments))
    return np.asarray(np.linalg.cholesky(np.linalg.inv(damped)).T)


def block_of(depth: int) -> int:
    """Weights a block: a divisor of the depth near 32, so that no block is ragged; the whole row if there is none."""
    fitting = [size for size in range(BLOCK // 2, 2 * BLOCK + 1) if depth % size == 0]
    return min(fitting, key=lambda size: abs(size - BLOCK)) if fitting else depth


def store(graph: Any, node: Any, weight: Any, blocks: Blocks) -> None:
    """Store the weights of a Gemm or Conv in int8; they are widened when the file is loaded and cost fp32's time.

    By a cast and a product: what stands behind DequantizeLinear the runtime would widen again at every call.
    """
    name, count = weight.name, blocks.scale.shape[1]
    constants = {
        "steps": blocks.steps.reshape(len(blocks.steps), count, -1),
        "scale": blocks.scale[..., None],
        "shape": np.array(weight.dims),
    }
    graph.initializer.extend(numpy_helper.from_array(value, f"{name}.{what}") for what, value in constants.items())
    widening = [
        helper.make_node("Cast", [f"{name}.steps"], [f"{name}.wide"], to=TensorProto.FLOAT),
        helper.make_node("Mul", [f"{name}.wide", f"{name}.scale"], [f"{name}.scaled"]),
        helper.make_node("Reshape", [f"{name}.scaled", f"{name}.shape"], [name]),
    ]
    place = list(graph.node).index(node)
    for offset, made in enumerate(widening):
        graph.node.insert(place + offset, made)
    graph.initializer.remove(weight)


def multiply(graph: Any, node: Any, weight: Any, blocks: Blocks) -> None:
    """Put a product of int8 in a Gemm's place: ONNX Runtime's MatMulNBits, its inputs rounded by block as they come."""
    rows, depth = blocks.steps.shape
    count = blocks.scale.shape[1]
    padded = np.zeros((rows, count * blocks.block), np.int16)
    padded[:, :depth] = blocks.steps
    name = weight.name
    stored = (padded + 128).astype(np.uint8).reshape(rows, count, blocks.block)
    graph.initializer.extend(
        [numpy_helper.from_array(stored, f"{name}.steps"), numpy_helper.from_array(blocks.scale, f"{name}.scale")]
    )
    product = helper.make_node(
        "MatMulNBits",
        [node.input[0], f"{name}.steps", f"{name}.scale", "", "", node.input[2]],
        list(node.output),
        name=node.name,
        domain="com.microsoft",
        K=depth,
        N=rows,
        bits=8,
        block_size=blocks.block,
        accuracy_level=ACCUMULATE_INT8,
    )
    place = list(graph.node).index(node)
    graph.node.remove(node)
    graph.node.insert(place, product)
    graph.initializer.remove(weight)
