"""fp32 -> int8: static per-channel QDQ with real frames, judged by the robot commands it would change.

Weights keep one bit in reserve (``reduce_range``): without VNNI, U8S8 products saturate in 16 bits, silently.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime.quantization as ortq
from numpy.typing import NDArray
from onnxruntime.quantization.shape_inference import quant_pre_process

from export.to_onnx import attach_card
from export.verify import Arrays, Model, decide, open_model, told
from service.contract import ContractError

OPERATORS = ["Conv", "Gemm"]
SAME_MM, SAME_DEG = 0.1, 0.1
SMALLEST_FP16 = 256
"""Smaller weights stay fp32: nothing to gain."""
GAIN = 0.7
"""A command is -0.7 of the estimate where class and estimate agree."""


@dataclass(frozen=True)
class Agreement:
    """How int8 decides against fp32 on the same decisions."""

    decisions: int
    same_class: float
    same_command: float
    sign_flips: int


class _Reader(ortq.CalibrationDataReader):  # type: ignore[misc]
    def __init__(self, feeds: list[Arrays]) -> None:
        self._feeds = iter(feeds)

    def get_next(self) -> Arrays | None:
        """Next input, None at the end."""
        return next(self._feeds, None)


def quantize(file: Path, out: Path, frames: NDArray[np.uint8]) -> Path:
    """Write the int8 twin of a released model; ``frames`` uint8 [N, T, 2, H, W, 3] are real decisions.

    Raises ContractError if the file is not an fp32 release or the int8 build saturates on this processor.
    """
    model = open_model(file)
    if model.card.quantisation != "none":
        raise ContractError(f"{file.name} is already {model.card.quantisation}, expected an fp32 release")
    out.parent.mkdir(parents=True, exist_ok=True)
    prepared = out.with_suffix(".prepared.onnx")
    try:
        quant_pre_process(str(file), str(prepared), skip_symbolic_shape=True)
        ortq.quantize_static(
            str(prepared),
            str(out),
            _Reader(_feeds(model, frames)),
            quant_format=ortq.QuantFormat.QDQ,
            op_types_to_quantize=OPERATORS,
            per_channel=True,
            reduce_range=True,
            activation_type=ortq.QuantType.QUInt8,
            weight_type=ortq.QuantType.QInt8,
        )
    finally:
        prepared.unlink(missing_ok=True)
    onnx.checker.check_model(str(out))
    attach_card(out, model.card.model_copy(update={"quantisation": "int8"}))
    _self_test(model, open_model(out), frames)
    return out


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
    attach_card(out, source.card.model_copy(update={"quantisation": "fp16"}))
    return out


def _feeds(model: Model, frames: NDArray[np.uint8]) -> list[Arrays]:
    """Every step of every decision, with the state it would see."""
    feeds: list[Arrays] = []
    for decision in frames:
        if model.card.form == "sequence":
            feeds.append({"frames": decision[None]} | told(model.card, 1))
            continue
        state = np.zeros((1, model.card.state_size), np.float32)
        for frame in decision:
            fed: Arrays = {"frame": frame[None], "reference": decision[:1], "state": state}
            feeds.append(fed | told(model.card, 1))
            state = model(feeds[-1])["next_state"]
    return feeds


def _self_test(model: Model, small: Model, frames: NDArray[np.uint8]) -> None:
    """Refuse a build whose outputs are far off: saturation shows as errors of the size of the outputs."""
    wanted, got = decide(model, frames), decide(small, frames)
    for name, value in wanted.items():
        gap = float(np.abs(value - got[name]).mean() / max(float(np.abs(value).mean()), 1e-6))
        if not gap < 0.25:
            raise ContractError(
                f"{small.file.name}: {name} is off by {100 * gap:.0f} % of its size; int8 saturates here"
            )


def agreement(direction: tuple[Model, Model], magnitude: tuple[Model, Model], frames: NDArray[np.uint8]) -> Agreement:
    """Compare (fp32, int8) pairs by class and by the command of the paper's rule on real decisions."""
    classes, commands = [], []
    for which in (0, 1):
        logits = decide(direction[which], frames)["logits"]
        error = decide(magnitude[which], frames)["error"]
        classes.append(logits.argmax(1))
        commands.append(_commands(direction[which], logits, error))
    apart = np.abs(commands[0] - commands[1])
    same = (apart[:, 0] <= SAME_MM) & (apart[:, 1] <= SAME_DEG)
    flips = int((commands[0] * commands[1] < 0).any(1).sum())
    return Agreement(len(frames), float((classes[0] == classes[1]).mean()), float(same.mean()), flips)


def _commands(model: Model, logits: NDArray[Any], error: NDArray[Any]) -> NDArray[np.float64]:
    """Eq. 1 of the paper: -0.7 d, -0.3 d without a class, -3 S where class and estimate contradict."""
    signs = np.array([(entry.sign_x, entry.sign_theta) for entry in model.card.classes])[logits.argmax(1)]
    agreeing = signs * error > 0
    command = np.where(agreeing, -GAIN * error, -3.0 * signs)
    return np.asarray(np.where(signs == 0, -0.3 * error, command), np.float64)
