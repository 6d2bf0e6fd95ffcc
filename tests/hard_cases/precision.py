"""Hard cases of precision: single against double, and int8, whose products saturate and whose activations have ends."""

import tempfile
from functools import lru_cache
from pathlib import Path

import numpy as np

from export.onnx.golden import hard_input
from export.onnx.model import Model, open_model
from export.onnx.verify import decide
from service.contract import Sensor
from tests.hard_cases.networks import LARGEST, PICTURES, golden, largest_of, released
from tests.hard_cases.registry import ROOT, case


@case(
    "networks",
    why="float32 keeps seven digits; a network that loses three of them is ill-conditioned",
    holds="the released architecture, with fresh weights, decides in float32 as in float64: relative gap",
    guard=(
        "training/networks/decider.py",
        "self.cell = nn.GRUCell(features + TOLD, settings.state_size)",
    ),
    limit=1e-4,
    quick=False,
)
def single_against_double_precision(seed: int) -> float:
    import torch

    from training.config import NetworkConfig
    from training.data.labels import CLASSES
    from training.networks import build

    torch.manual_seed(seed)
    network = build(NetworkConfig(), len(CLASSES), Sensor.load()).eval()
    fields = torch.randn(4, 8, 2, 3, 20, 21)
    told = torch.tensor([[56.0, 30.0]]).repeat(4, 1)
    with torch.no_grad():
        single = network.logits(network.read_fields(fields, told))
        torch.set_default_dtype(torch.float64)
        try:
            double = network.double().logits(network.read_fields(fields.double(), told.double()))
        finally:
            torch.set_default_dtype(torch.float32)
    return float((single.double() - double).abs().max() / double.abs().max())


@lru_cache
def _small(name: str) -> Model:
    """int8 twin of a released step model that reads pictures, multiplied in int8 where it can be."""
    from export.onnx.decisions import Decision
    from export.quantise.quantise import quantize

    truth = np.zeros(2, np.float32)
    calibrating = [Decision(golden(seed), 56.0, 30.0, truth, "golden") for seed in range(4)]
    out = Path(tempfile.mkdtemp(prefix="hard-cases-")) / f"{Path(name).name}.step.onnx"
    return open_model(quantize(ROOT / "models" / f"{name}.step.onnx", out, calibrating, dynamic=True))


@case(
    "networks",
    why="without VNNI, products of u8 and s8 saturate in 16 bits and say nothing",
    holds="where this processor's products saturate, two of the largest fit 16 bits: their sum",
    guard=("export/trunk.py", "reach = CAREFUL_REACH if saturates() else REACH", "reach = REACH"),
    limit=2**15 - 1,
)
def int8_with_a_bit_in_reserve(seed: int) -> float:
    from unittest import mock

    from export import trunk

    weights = np.random.default_rng(seed).normal(size=(32, 3, 11, 11))
    with mock.patch.object(trunk, "saturates", return_value=True):
        steps, _ = trunk.round_rows(weights)
    return float(2 * 255 * (np.abs(steps).max() + trunk.WEIGHT_ZERO))


@case(
    "networks",
    why="extreme inputs drive every quantised activation to the ends of its 256 steps",
    holds="the int8 twins stay finite and bounded on every hard input: largest",
    guard=("export/quantise/quantise.py", "_self_test(model, open_model(out), decisions[:2])"),
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
    holds="the int8 twins stay near fp32 on golden frames that they were not rounded for: mean gap relative to the output",
    guard=("export/quantise/quantise.py", "if not gap < FAR_OFF:"),
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
