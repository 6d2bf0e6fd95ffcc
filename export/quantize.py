"""fp32 -> int8: static per-channel QDQ with real frames, judged by the robot commands it would change.

Weights keep one bit in reserve (``reduce_range``): without VNNI, U8S8 products saturate in 16 bits, silently. A first
layer that reads a frame beside its change stays fp32: of 256 steps over both, the change, a few grey levels, would get
hardly any.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime.quantization as ortq
from numpy.typing import NDArray
from onnxruntime.quantization.shape_inference import quant_pre_process
from rich.progress import track

from export.points import wilson
from export.runtime import session
from export.to_onnx import attach_card
from export.verify import Arrays, Model, decide, open_model, told
from service.contract import ContractError, ModelCard
from service.perception.sequence import track_pairs
from training.labels import class_of

OPERATORS = ["Conv", "Gemm", "MatMul"]
PICTURED = {"frame", "frames", "reference"}
SAME_MM, SAME_DEG = 0.1, 0.1
CALIBRATION_DECISIONS = 16
KEPT_SHARE = 0.995
"""Least share of decisions a chosen set of int8 layers may keep; the two networks of a pair together keep 0.99."""
SAFETY = 2.0
"""They must keep them even if outputs moved this much further: the decisions that choose are few."""
SMALLEST_FP16 = 256
"""Smaller weights stay fp32: nothing to gain."""
GAIN = 0.7
"""A command is -0.7 of the estimate where class and estimate agree."""


@dataclass(frozen=True)
class Agreement:
    """How int8 decides against fp32 on the same decisions."""

    decisions: int
    same_class: float
    same_commands: int
    sign_flips: int
    apart_p99_mm: float
    apart_p99_deg: float

    @property
    def same_command(self) -> float:
        """Share of decisions whose command stays within 0.1 mm and 0.1 deg."""
        return self.same_commands / self.decisions

    @classmethod
    def of(
        cls,
        classes: tuple[NDArray[np.int64], NDArray[np.int64]],
        commands: tuple[NDArray[np.float64], NDArray[np.float64]],
    ) -> "Agreement":
        """Compare classes [N] and commands [N, 2] in (mm, deg) of the same decisions."""
        apart = np.abs(commands[0] - commands[1])
        same = int(((apart[:, 0] <= SAME_MM) & (apart[:, 1] <= SAME_DEG)).sum())
        flips = int((commands[0] * commands[1] < 0).any(1).sum())
        far_mm, far_deg = (float(value) for value in np.quantile(apart, 0.99, 0))
        return cls(len(apart), float((classes[0] == classes[1]).mean()), same, flips, far_mm, far_deg)

    def __str__(self) -> str:
        """One line, with the interval of the share."""
        share, low, high = wilson(self.same_commands, self.decisions)
        return (
            f"{100 * share:.1f} % [{100 * low:.1f}, {100 * high:.1f}] of {self.decisions} commands within {SAME_MM} mm"
            f" and {SAME_DEG} deg (99 % within {self.apart_p99_mm:.2f} mm, {self.apart_p99_deg:.2f} deg),"
            f" {100 * self.same_class:.1f} % the same class, {self.sign_flips} sign flips"
        )


class _Reader(ortq.CalibrationDataReader):  # type: ignore[misc]
    def __init__(self, feeds: list[Arrays]) -> None:
        self._feeds = iter(feeds)

    def get_next(self) -> Arrays | None:
        """Next input, None at the end."""
        return next(self._feeds, None)


def quantize(
    file: Path, out: Path, frames: NDArray[np.uint8], judged: NDArray[np.uint8] | None = None
) -> tuple[Path, list[str]]:
    """Write the int8 twin of a released model; ``frames`` uint8 [N, T, 2, H, W, 3] are real decisions to calibrate on.

    With ``judged``, decisions of the same shape, only those layers become int8 that leave the command of 99.5 % of them
    within 0.1 mm and 0.1 deg with room to spare, taken from the costliest down; otherwise all. Returns the file and the
    int8 layers. Raises ContractError if the file is not an fp32 release or the int8 build saturates on this processor.
    """
    model = open_model(file)
    if model.card.quantisation != "none":
        raise ContractError(f"{file.name} is already {model.card.quantisation}, expected an fp32 release")
    frames, judged = seen(model.card, frames), None if judged is None else seen(model.card, judged)
    out.parent.mkdir(parents=True, exist_ok=True)
    prepared = out.with_suffix(".prepared.onnx")
    try:
        quant_pre_process(str(file), str(prepared), skip_symbolic_shape=True)
        feeds = _feeds(model, frames)
        layers = int8_layers(prepared)
        if judged is not None:
            layers = _harmless(model, prepared, out, layers, feeds, judged)
        if not layers:
            raise ContractError(f"{file.name}: no layer can be int8 without changing commands")
        _build(prepared, out, layers, feeds)
    finally:
        prepared.unlink(missing_ok=True)
    onnx.checker.check_model(str(out))
    attach_card(out, model.card.model_copy(update={"quantisation": "int8", "self_test": None}))
    _self_test(model, open_model(out), frames)
    return out, layers


def seen(card: ModelCard, frames: NDArray[Any]) -> NDArray[Any]:
    """Decisions as a card's graph reads them: frames [N, T, 2, H, W, 3] tracked, if it reads markers."""
    if not card.markers or frames.shape[3:] == card.input_shape:
        return frames
    return np.stack([track_pairs(decision) for decision in frames])


def _build(prepared: Path, out: Path, layers: list[str], feeds: list[Arrays]) -> None:
    ortq.quantize_static(
        str(prepared),
        str(out),
        _Reader(feeds),
        quant_format=ortq.QuantFormat.QDQ,
        op_types_to_quantize=OPERATORS,
        nodes_to_quantize=layers,
        per_channel=True,
        reduce_range=True,
        activation_type=ortq.QuantType.QUInt8,
        weight_type=ortq.QuantType.QInt8,
    )


def int8_layers(prepared: Path) -> list[str]:
    """Names of the nodes with weights that could be int8, costliest first by the multiplications of a batch of one.

    A layer that reads several quantities of the input side by side, on one scale, is not among them.
    """
    graph = onnx.load(str(prepared)).graph
    weights = {tensor.name: tuple(tensor.dims) for tensor in graph.initializer}
    places = {value.name: _places(value) for value in [*graph.value_info, *graph.output]}
    cost = {}
    seen_alone, side_by_side = set(PICTURED), set[str]()
    for node in graph.node:
        given = set(node.input)
        weighs = node.op_type in OPERATORS and len(node.input) > 1 and node.input[1] in weights
        if not weighs and node.op_type != "Shape" and given & (seen_alone | side_by_side):
            mixed = node.op_type == "Concat" or given & side_by_side
            (side_by_side if mixed else seen_alone).update(node.output)
        elif weighs and not given & side_by_side:
            size = float(np.prod(weights[node.input[1]]))
            cost[node.name] = size * (places.get(node.output[0], 1.0) if node.op_type == "Conv" else 1.0)
    return sorted(cost, key=lambda name: -cost[name])


def _places(value: Any) -> float:
    return float(np.prod([max(dim.dim_value, 1) for dim in value.type.tensor_type.shape.dim[2:]]))


def _harmless(
    model: Model, prepared: Path, out: Path, layers: list[str], feeds: list[Arrays], judged: NDArray[np.uint8]
) -> list[str]:
    """Layer after layer, keep the int8 ones with which enough commands stay what they were."""
    wanted = decide(model, judged)
    kept: list[str] = []
    for layer in track(layers, description=f"int8 layers of {model.file.name}", transient=True):
        _build(prepared, out, [*kept, layer], feeds)
        got = decide(Model(out, model.card, session(out)), judged)
        further = {name: value + SAFETY * (got[name] - value) for name, value in wanted.items()}
        if float(same_commands(model.card, wanted, further).mean()) >= KEPT_SHARE:
            kept.append(layer)
    return kept


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


def agreement(exact: tuple[Model, ...], small: tuple[Model, ...], frames: NDArray[np.uint8]) -> Agreement:
    """Compare two sets of models that decide (a pair, one graph of both, a joint density) by their commands."""
    (classes, commands), (their_classes, theirs) = _decided(exact, frames), _decided(small, frames)
    return Agreement.of((classes, their_classes), (commands, theirs))


def _decided(models: tuple[Model, ...], frames: NDArray[np.uint8]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    outputs: Arrays = {}
    for model in models:
        outputs |= decide(model, seen(model.card, frames))
    card = models[0].card
    if card.role == "joint":
        commands = command(card, outputs)
        return class_of((-commands / GAIN).astype(np.float32)), commands
    return outputs["logits"].argmax(1), paper_rule(card, outputs["logits"], outputs["error"])


def same_commands(card: ModelCard, wanted: Arrays, got: Arrays) -> NDArray[np.bool_]:
    """Which decisions of one network lead to the same command within 0.1 mm and 0.1 deg; of a class, to the same."""
    if card.role == "direction":
        return np.asarray(wanted["logits"].argmax(1) == got["logits"].argmax(1))
    apart = np.abs(command(card, wanted) - command(card, got))
    return np.asarray((apart[:, 0] <= SAME_MM) & (apart[:, 1] <= SAME_DEG))


def command(card: ModelCard, outputs: Arrays) -> NDArray[np.float64]:
    """Command [N, 2] in (mm, deg) of one network's outputs; without a class, -0.7 of the estimate."""
    if card.role == "joint":
        return -GAIN * density_mean(card, outputs["log_density"])
    if card.role == "magnitude":
        return np.asarray(-GAIN * outputs["error"], np.float64)
    return paper_rule(card, outputs["logits"], outputs["error"])


def density_mean(card: ModelCard, log_density: NDArray[Any]) -> NDArray[np.float64]:
    """Mean error [N, 2] in (mm, deg) of a joint density."""
    weight = np.exp(log_density.astype(np.float64) - log_density.max((1, 2), keepdims=True))
    weight /= weight.sum((1, 2), keepdims=True)
    return np.stack([weight.sum(2) @ np.array(card.grid_x_mm), weight.sum(1) @ np.array(card.grid_theta_deg)], 1)


def paper_rule(card: ModelCard, logits: NDArray[Any], error: NDArray[Any]) -> NDArray[np.float64]:
    """Eq. 1 of the paper: -0.7 d, -0.3 d without a class, -3 S where class and estimate contradict."""
    signs = np.array([(entry.sign_x, entry.sign_theta) for entry in card.classes])[logits.argmax(1)]
    agreeing = signs * error > 0
    stepped = np.where(agreeing, -GAIN * error, -3.0 * signs)
    return np.asarray(np.where(signs == 0, -0.3 * error, stepped), np.float64)
