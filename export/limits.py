"""The hardware limit of a graph: its multiplications at this core's GEMM rate, its bytes at this core's memory rate.

Both are probed here and now, by the same runtime. A graph cannot be faster than its layers one after the other, each at
the slower of the two; a layer's bytes are its weights and what it reads and writes, so that frames and activations
count. Pooling, gates and the runtime's own work come on top and are what a kernel could still save. Two limits differ
in the rate of multiplications: ``limit_ms`` takes the best that the core reaches on any large product, ``shaped_ms``
that of the plain matrix product of every layer's own rows, depth and columns, which a convolution that gathers its
patches besides can at best equal (the runtime's direct fp32 ones do not gather). A shallow or narrow product cannot
fill the units.
"""

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import onnx
import onnxruntime
from numpy.typing import NDArray
from onnx import TensorProto, helper

from export.bench.measure import example_inputs, time_calls
from export.onnx.model import Arrays, Model

MATMUL_SIZES = (512, 1024)
CONV = (256, 28)
"""Channels and side of the probed 3 x 3 convolution: AlexNet's later layers have this shape."""
LEAST_BYTES = 1_000_000
PROBE_S = 0.1
WEIGHT_AT = {"Conv": 1, "Gemm": 1, "MatMul": 1, "MatMulInteger": 1, "MatMulNBits": 1, "QGemm": 3, "QLinearConv": 3}
"""Which input of an operator its weights are."""
BYTES = (TensorProto.INT8, TensorProto.UINT8)


@dataclass(frozen=True)
class Peaks:
    """What one core does at best: multiplications and additions a second, in fp32 and int8, and bytes read."""

    fp32_gflops: float
    int8_gops: float
    read_gb_s: float

    def as_dict(self) -> dict[str, float]:
        """Plain numbers."""
        return asdict(self)


@dataclass(frozen=True)
class Layer:
    """A layer with weights as the runtime ran it: ``times`` products of [rows, depth] by [depth, columns]."""

    times: int
    rows: int
    depth: int
    columns: int
    small: bool
    """int8, otherwise fp32."""
    convolves: bool = False
    moved_bytes: float = 0.0
    """Of what it reads and writes besides its weights."""

    @property
    def products(self) -> float:
        """Multiplications."""
        return float(self.times * self.rows * self.depth * self.columns)

    @property
    def weight_bytes(self) -> float:
        """Bytes of the weights; they are read once."""
        return float(self.depth * self.columns * (1 if self.small else 4))

    def limit_ms(self, peaks: Peaks) -> float:
        """The slower of arithmetic at the core's peak and memory."""
        rate = peaks.int8_gops if self.small else peaks.fp32_gflops
        return max(2 * self.products / (rate * 1e6), self._moving_ms(peaks))

    def shaped_ms(self, peaks: Peaks) -> float:
        """The slower of the plain matrix product of the same shape, probed now, and memory."""
        return max(
            self.times * product_ms(self.rows, self.depth, self.columns, small=self.small), self._moving_ms(peaks)
        )

    def _moving_ms(self, peaks: Peaks) -> float:
        return (self.weight_bytes + self.moved_bytes) / (peaks.read_gb_s * 1e6)


@dataclass(frozen=True)
class Work:
    """What a graph must do at least, layer by layer as the runtime ran it."""

    layers: tuple[Layer, ...]

    @property
    def weight_bytes(self) -> float:
        """Bytes of all weights of the counted layers."""
        return sum(layer.weight_bytes for layer in self.layers)

    def limit_ms(self, peaks: Peaks) -> float:
        """Sum over the layers, arithmetic at the core's peak."""
        return sum(layer.limit_ms(peaks) for layer in self.layers)

    def shaped_ms(self, peaks: Peaks, *, convolves: bool | None = None) -> float:
        """Sum over the layers, or over the convolutions or products alone, each at the rate of its own shape."""
        chosen = (layer for layer in self.layers if convolves in (None, layer.convolves))
        return sum(layer.shaped_ms(peaks) for layer in chosen)


@lru_cache(maxsize=256)
def product_ms(rows: int, depth: int, columns: int, *, small: bool, seconds: float = PROBE_S) -> float:
    """Processor time of one matrix product by constant weights, warm, on one thread: the runtime's own kernel."""
    run = _matmul(np.random.default_rng(0), (rows, depth, columns), small=small)
    return time_calls(run, seconds=seconds, least=5).cpu_p50_ms


def probe(working_set_bytes: float, seconds: float = 0.5) -> Peaks:
    """Measure the peaks on one thread; memory is read from a buffer as large as the graph's weights."""
    fp32 = max(_rate(run, operations, seconds) for run, operations in _probes(small=False))
    int8 = max(_rate(run, operations, seconds) for run, operations in _probes(small=True))
    buffer = np.ones(int(max(working_set_bytes, LEAST_BYTES)) // 4, np.float32)
    timing = time_calls(buffer.max, seconds=seconds, least=5)
    return Peaks(fp32, int8, buffer.nbytes / (timing.cpu_p50_ms * 1e6))


def _rate(run: Callable[[], Any], operations: float, seconds: float) -> float:
    return operations / (time_calls(run, seconds=seconds, least=5).cpu_p50_ms * 1e6)


def _probes(*, small: bool) -> Iterator[tuple[Callable[[], Any], float]]:
    rng = np.random.default_rng(0)
    for size in MATMUL_SIZES:
        yield _matmul(rng, (size, size, size), small=small), 2.0 * size**3
    channels, side = CONV
    yield _convolution(rng, small=small), 2.0 * channels * channels * 9 * side * side


def _matmul(rng: np.random.Generator, shape: tuple[int, int, int], *, small: bool) -> Callable[[], Any]:
    rows, depth, columns = shape
    kind = TensorProto.UINT8 if small else TensorProto.FLOAT
    size = (depth, columns)
    weight = rng.integers(-60, 60, size).astype(np.int8) if small else rng.random(size, np.float32) - 0.5
    given = rng.integers(0, 255, (rows, depth)).astype(np.uint8 if small else np.float32)
    node = helper.make_node("MatMulInteger" if small else "MatMul", ["a", "b"], ["c"])
    return _run([node], {"b": weight}, given, kind, TensorProto.INT32 if small else TensorProto.FLOAT)


def _convolution(rng: np.random.Generator, *, small: bool) -> Callable[[], Any]:
    channels, side = CONV
    shape = (1, channels, side, side)
    if not small:
        weight = rng.random((channels, channels, 3, 3), np.float32) - 0.5
        node = helper.make_node("Conv", ["a", "b"], ["c"], pads=[1, 1, 1, 1])
        return _run([node], {"b": weight}, rng.random(shape, np.float32), TensorProto.FLOAT, TensorProto.FLOAT)
    constants = {
        "scale": np.float32(0.01),
        "zero": np.uint8(128),
        "b": rng.integers(-60, 60, (channels, channels, 3, 3)).astype(np.int8),
        "b_scale": np.float32(0.01),
        "b_zero": np.int8(0),
    }
    names = ["a", "scale", "zero", "b", "b_scale", "b_zero", "scale", "zero"]
    node = helper.make_node("QLinearConv", names, ["c"], pads=[1, 1, 1, 1])
    given = rng.integers(0, 255, shape).astype(np.uint8)
    return _run([node], constants, given, TensorProto.UINT8, TensorProto.UINT8)


def _run(nodes: list[Any], constants: dict[str, Any], given: NDArray[Any], kind: int, out: int) -> Callable[[], Any]:
    graph = helper.make_graph(
        nodes,
        "probe",
        [helper.make_tensor_value_info("a", kind, list(given.shape))],
        [helper.make_tensor_value_info("c", out, None)],
        [onnx.numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.log_severity_level = 3
    run = onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
    return lambda: run.run(None, {"a": given})


def work_of(model: Model) -> Work:
    """Multiplications and bytes of every layer with weights, for a batch of one.

    Shapes are those of one real run whose intermediate results are asked for.
    """
    graph = onnx.load(str(model.file))
    weights = _weights(graph.graph)
    nodes = [n for n in graph.graph.node if n.op_type in WEIGHT_AT and n.input[WEIGHT_AT[n.op_type]] in weights]
    made = _tensors(graph, [name for node in nodes for name in (node.input[0], node.output[0])], example_inputs(model))
    return Work(tuple(_layer(node, weights, made) for node in nodes))


def _layer(node: Any, weights: dict[str, tuple[tuple[int, ...], bool]], made: Arrays) -> Layer:
    given, out = made[node.input[0]], made[node.output[0]]
    shape, small = weights[node.input[WEIGHT_AT[node.op_type]]]
    moved = float(given.nbytes + out.nbytes)
    if node.op_type in ("Conv", "QLinearConv"):  # each image's places by the weights of every filter
        places = out.size // (len(out) * shape[0])
        return Layer(len(out), places, int(np.prod(shape[1:])), shape[0], small, convolves=True, moved_bytes=moved)
    columns = out.shape[-1]
    return Layer(1, out.size // columns, given.shape[-1], columns, small, moved_bytes=moved)


def _weights(graph: Any) -> dict[str, tuple[tuple[int, ...], bool]]:
    """Shape of every constant a layer may multiply by, and whether in int8; seen through widening and tiling."""
    stored = {tensor.name: (tuple(tensor.dims), tensor.data_type) for tensor in graph.initializer}
    arrays = {tensor.name: onnx.numpy_helper.to_array(tensor) for tensor in graph.initializer if len(tensor.dims) == 1}
    found = {name: (shape, kind in BYTES) for name, (shape, kind) in stored.items()}
    for node in graph.node:
        if node.input and node.input[0] in found:
            shape, small = found[node.input[0]]
            if node.op_type in ("Cast", "Mul"):  # stored in fewer bits, widened on loading: multiplied in fp32
                found[node.output[0]] = (shape, False)
            if node.op_type == "Reshape":
                found[node.output[0]] = (tuple(int(size) for size in arrays[node.input[1]]), small)
            if node.op_type == "Tile":
                times = arrays[node.input[1]]
                sizes = tuple(size * int(count) for size, count in zip(shape, times, strict=True))
                found[node.output[0]] = (sizes, small)
    return found


def _tensors(graph: Any, names: list[str], inputs: Arrays) -> Arrays:
    wanted = [name for name in dict.fromkeys(names) if name not in inputs]
    del graph.graph.output[:]
    graph.graph.output.extend(onnx.ValueInfoProto(name=name) for name in wanted)
    options = onnxruntime.SessionOptions()
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    options.log_severity_level = 3
    run = onnxruntime.InferenceSession(graph.SerializeToString(), options, providers=["CPUExecutionProvider"])
    return dict(zip(wanted, run.run(wanted, inputs), strict=True)) | inputs
