"""Hard cases of precision: single against double, and int8, whose products saturate and whose activations have ends."""

import math
import tempfile
from functools import lru_cache
from pathlib import Path

import numpy as np

from export.onnx.decisions import Decision
from export.onnx.golden import hard_input
from export.onnx.model import Model, open_model
from export.onnx.verify import decide
from export.quantise.quantise import FarOffError, quantise, refuse_far_off
from service.contract import Sensor
from tests.hard_cases.registry import ROOT, Guard, case
from tests.hard_cases.rooms.networks import LARGEST, PICTURES, golden, largest_of, released


@case(
    "networks",
    why="float32 keeps seven digits; a network that loses three of them is ill-conditioned",
    holds="the released architecture, with fresh weights, decides in float32 as in float64: relative gap",
    guard="training.networks.decider:Trunk.advance",
    limit=1e-4,
    quick=False,
)
def single_against_double_precision(seed: int) -> float:
    import torch

    from training.data.labels import CLASSES
    from training.networks import build
    from training.networks.settings import NetworkConfig

    torch.manual_seed(seed)
    network = build(NetworkConfig(), len(CLASSES), Sensor.load()).eval()
    fields = torch.randn(4, 8, 2, 3, 20, 21)
    geometry = torch.tensor([[56.0, 30.0]]).repeat(4, 1)
    with torch.no_grad():
        single = network.logits(network.read_fields(fields, geometry))
        torch.set_default_dtype(torch.float64)
        try:
            double = network.double().logits(network.read_fields(fields.double(), geometry.double()))
        finally:
            torch.set_default_dtype(torch.float32)
    return float((single.double() - double).abs().max() / double.abs().max())


@lru_cache
def _small(name: str) -> Model:
    """int8 build of a released step model that reads pictures, calibrated on golden frames."""
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) / f"{Path(name).name}.step.onnx"
        return open_model(quantise(ROOT / "models" / f"{name}.step.onnx", out, _golden_decisions()))


def _golden_decisions() -> list[Decision]:
    return [Decision(golden(seed), 56.0, 30.0) for seed in range(4)]


@case(
    "networks",
    why="products that saturate in 16 bits, or a scale calibrated on other frames, are silently wrong",
    holds="a build whose outputs are a quarter off is refused: builds that pass",
    guard=Guard("export.quantise.quantise:FAR_OFF", "no build is far off", math.inf),
    quick=False,
)
def int8_far_from_fp32(seed: int) -> float:
    import onnx

    model = released("pictures/direction")
    graph = onnx.load(str(model.file))
    weights = next(tensor for tensor in graph.graph.initializer if tensor.name.endswith("direction.weight"))
    values = onnx.numpy_helper.to_array(weights)
    kept = np.random.default_rng(seed).random(values.shape) < 0.5  # half of the head is lost
    weights.CopyFrom(onnx.numpy_helper.from_array(values * kept, weights.name))
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "far.onnx"
        onnx.save(graph, str(file))
        try:
            refuse_far_off(model, open_model(file), _golden_decisions()[:2])
        except FarOffError:
            return 0.0
    return 1.0


@case(
    "networks",
    why="extreme inputs drive every quantised activation to the ends of its 256 steps",
    holds="int8 builds stay finite and bounded on every hard input: largest",
    guard="export.quantise.quantise:refuse_far_off",
    limit=LARGEST,
    quick=False,
)
def int8_at_its_extremes(_seed: int) -> float:
    worst = 0.0
    for name in PICTURES:
        model = _small(name)
        for frames in hard_input(model.card).values():
            worst = max(worst, largest_of(decide(model, frames[None])))
    return worst


@case(
    "networks",
    why="a weight of eight bits is off by a 250th of the largest beside it, and a state carries that on",
    holds="an int8 build stays near fp32 on golden frames that did not calibrate it: mean gap relative to the output",
    guard="export.quantise.quantise:BLOCK",
    limit=0.02,
    quick=False,
)
def int8_near_fp32(seed: int) -> tuple[float, str]:
    flags = Path("/proc/cpuinfo").read_text()
    frames = np.stack([golden(10 + seed)])
    worst = 0.0
    for name in PICTURES:
        wanted, got = decide(released(name), frames), decide(_small(name), frames)
        worst = max(worst, *(float(np.abs(wanted[n] - got[n]).mean() / np.abs(wanted[n]).mean()) for n in wanted))
    return worst, "processor with VNNI" if "vnni" in flags else "processor without VNNI"
