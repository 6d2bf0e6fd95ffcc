"""int8 builds of a released step model by ONNX Runtime's own quantiser.

``static`` multiplies in int8 with scales from calibration decisions, ``dynamic`` with scales of every call. ``blocked``
stores the weights of the fully connected and recurrent layers in blocks of 16 that share a scale. ``python -m export
benchmark --int8`` shows which of them pay, by the robot commands that they would change.
"""

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import onnx
from onnxruntime.quantization import CalibrationDataReader, quantize_dynamic, quantize_static
from onnxruntime.quantization.matmul_nbits_quantizer import MatMulNBitsQuantizer
from onnxruntime.quantization.onnx_model import ONNXModel

from export.onnx.decisions import Decision
from export.onnx.model import Arrays, Model, geometry_inputs, open_model
from export.onnx.to_onnx import attach_card
from service.contract import ContractError

Mode = Literal["static", "dynamic", "blocked"]
MODES: tuple[Mode, ...] = get_args(Mode)
LAYERS = ("Conv", "Gemm")
CALIBRATION_DECISIONS = 16
BLOCK = 16
ACCUMULATE_INT8 = 4
"""``accuracy_level`` of MatMulNBits: inputs are rounded to int8, block by block, on arrival."""
FAR_OFF = 0.25
"""Share of the outputs' size: an int8 build that differs by more computes something else."""


class FarOffError(ContractError):
    """An int8 build computes something else on this processor."""


class _Calibration(CalibrationDataReader):  # type: ignore[misc]
    def __init__(self, inputs: Iterator[Arrays]) -> None:
        self._inputs = inputs

    def get_next(self) -> Arrays | None:
        return next(self._inputs, None)


def quantise(file: Path, out: Path, decisions: Sequence[Decision], mode: Mode = "blocked") -> Path:
    """Write the int8 build of a released fp32 step model; ``decisions`` calibrate it and check it afterwards.

    Raises ContractError if the file is not an fp32 release in step form or has no layer to quantise, FarOffError if the
    build computes something else on this processor.
    """
    model = open_model(file)
    if model.card.quantisation != "none" or model.card.form != "step":
        what = f"{model.card.form}, {model.card.quantisation}"
        raise ContractError(f"{file.name} is already int8 or no step ({what}), expected an fp32 step release")
    graph = onnx.load(str(file))
    if not any(node.op_type in LAYERS for node in graph.graph.node):
        raise ContractError(f"{file.name} holds no layer with weights")
    del graph.graph.value_info[:]  # the quantiser transposes weights and would find stale shapes there
    out.parent.mkdir(parents=True, exist_ok=True)
    with _quiet():
        _build(graph, out, mode, _Calibration(feeds(model, decisions)))
    attach_card(out, model.card.model_copy(update={"quantisation": "int8", "self_test": None}))
    refuse_far_off(model, open_model(out), decisions[:2])
    return out


def _build(graph: Any, out: Path, mode: Mode, calibration: _Calibration) -> None:
    # with seven-bit weights: without VNNI, processors add two products of eight bits in 16 bits, which overflow
    if mode == "static":
        options = {"op_types_to_quantize": list(LAYERS), "per_channel": True, "reduce_range": True}
        quantize_static(graph, out, calibration, **options)
    elif mode == "dynamic":
        options = {"op_types_to_quantize": ["Gemm", "MatMul"], "per_channel": True, "reduce_range": True}
        quantize_dynamic(graph, out, **options)
    else:
        products = ONNXModel(graph)
        products.replace_gemm_with_matmul()
        blocked = MatMulNBitsQuantizer(
            products.model, bits=8, block_size=BLOCK, is_symmetric=True, accuracy_level=ACCUMULATE_INT8
        )
        blocked.process()
        blocked.model.save_model_to_file(str(out))


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence the quantiser, which logs every node and advises preparing a graph that needs no preparation."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(before)


def feeds(model: Model, decisions: Sequence[Decision]) -> Iterator[Arrays]:
    """The inputs of every step of every decision, with the matching recurrent state."""
    for decision in decisions:
        frames = decision.input_of(model.card)
        state = np.zeros((1, model.card.state_size), np.float32)
        for frame in frames:
            inputs: Arrays = {"frame": frame[None], "reference": frames[:1], "state": state}
            inputs |= geometry_inputs(model.card, 1, decision.gap_width_mm, decision.grasp_height_mm)
            yield inputs
            state = model(inputs)["next_state"]


def refuse_far_off(model: Model, build: Model, decisions: Sequence[Decision]) -> None:
    """Raise FarOffError on a build whose outputs are far off: saturation causes errors of the outputs' own size."""
    gap, size = dict[str, float](), dict[str, float]()
    for inputs in feeds(model, decisions):
        expected, actual = model(inputs), build(inputs)
        for name, value in expected.items():
            gap[name] = gap.get(name, 0.0) + float(np.abs(value - actual[name]).mean())
            size[name] = size.get(name, 0.0) + float(np.abs(value).mean())
    for name, total in gap.items():
        share = total / max(size[name], 1e-6)
        if not share < FAR_OFF:
            raise FarOffError(f"{model.file.name}: {name} is off by {100 * share:.0f} % of its size in int8")
