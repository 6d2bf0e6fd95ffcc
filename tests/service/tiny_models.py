"""Tiny but real ONNX networks with valid cards: uint8 in, difference to the reference, pooled, state passed on."""

from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from service.contract import ErrorClass, FrameSpec, ModelCard

SPEC = FrameSpec(height_px=320, width_px=327)
SIGNS = {"1": (-1, 0), "2": (1, 0), "3": (-1, 1), "4": (-1, -1), "5": (1, 1), "6": (1, -1), "7": (0, -1), "8": (0, 1)}
CLASSES = tuple(ErrorClass(name=n, sign_x=x, sign_theta=t) for n, (x, t) in (SIGNS | {"near": (0, 0)}).items())
STATE = 6


def card(role: str, form: str, **changes: Any) -> ModelCard:
    """A valid card."""
    facts: dict[str, Any] = {
        "name": f"tiny-{role}",
        "role": role,
        "form": form,
        "frame": SPEC,
        "frames_per_decision": 8,
        "state_size": STATE,
        "classes": CLASSES,
        "has_sigma": role == "magnitude",
        "training_data_sha256": "0" * 64,
        "git_commit": "0" * 40,
        "validation": {},
        "verified_on_cpu": "none",
    }
    return ModelCard.model_validate(facts | changes)


def _constant(name: str, values: Any, kind: Any = np.float32) -> onnx.TensorProto:
    return numpy_helper.from_array(np.asarray(values, kind), name)


def _heads(role: str, rng: np.random.Generator) -> tuple[list[Any], list[Any], list[Any]]:
    outputs: list[Any] = []
    nodes: list[Any] = []
    weights: list[Any] = []
    widths = {"logits": len(CLASSES)} if role == "direction" else {"error": 2, "log_sigma": 2}
    for name, width in widths.items():
        weights.append(_constant(f"w_{name}", rng.normal(size=(STATE, width))))
        weights.append(_constant(f"b_{name}", np.full(width, 0.7)))
        nodes.append(helper.make_node("MatMul", ["next_state", f"w_{name}"], [f"m_{name}"]))
        nodes.append(helper.make_node("Add", [f"m_{name}", f"b_{name}"], [name]))
        outputs.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", width]))
    return nodes, weights, outputs


def step_model(role: str, seed: int = 0, **changes: Any) -> onnx.ModelProto:
    """A step network: next_state = state / 2 + mean colour difference of each finger; outputs are linear in it."""
    model_card = card(role, "step", **changes)
    shape = ["batch", 2, *model_card.frame.shape]
    inputs = [
        helper.make_tensor_value_info("frame", TensorProto.UINT8, shape),
        helper.make_tensor_value_info("reference", TensorProto.UINT8, shape),
        helper.make_tensor_value_info("state", TensorProto.FLOAT, ["batch", STATE]),
    ]
    heads, weights, outputs = _heads(role, np.random.default_rng(seed))
    nodes = [
        helper.make_node("Cast", ["frame"], ["f"], to=TensorProto.FLOAT),
        helper.make_node("Cast", ["reference"], ["r"], to=TensorProto.FLOAT),
        helper.make_node("Sub", ["f", "r"], ["d"]),
        helper.make_node("ReduceMean", ["d", "axes"], ["pooled"], keepdims=0),
        helper.make_node("Reshape", ["pooled", "flat"], ["features"]),
        helper.make_node("Mul", ["state", "half"], ["old"]),
        helper.make_node("Add", ["old", "features"], ["next_state"]),
        *heads,
    ]
    constants = [_constant("axes", [2, 3], np.int64), _constant("flat", [-1, STATE], np.int64), _constant("half", 0.5)]
    outputs.append(helper.make_tensor_value_info("next_state", TensorProto.FLOAT, ["batch", STATE]))
    graph = helper.make_graph(nodes, model_card.name, inputs, outputs, constants + weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    helper.set_model_props(model, model_card.to_props())
    return model


def write_models(folder: Path, **changes: Any) -> Path:
    """A folder with a direction and a magnitude step network."""
    folder.mkdir(parents=True, exist_ok=True)
    for seed, role in enumerate(("direction", "magnitude")):
        onnx.save(step_model(role, seed, **changes), str(folder / f"{role}.step.onnx"))
    return folder
