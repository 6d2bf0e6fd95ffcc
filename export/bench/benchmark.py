"""``python -m export benchmark``: the cost of a decision here, whether int8 pays, and the paper's networks."""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from export.bench import paper
from export.bench.measure import time_in_turn, together, undisturbed
from export.bench.report import NAME, benchmark_page
from export.onnx.decisions import Decision
from export.onnx.golden import golden_frames
from export.onnx.model import Model, open_model
from export.quantise.agreement import same_commands
from export.quantise.quantise import CALIBRATION_DECISIONS, MODES, quantise
from reporting.machine import commit, cpu_name
from reporting.page import publish
from service.contract import ContractError, Sensor

Row = dict[str, Any]


def benchmark(
    files: Sequence[Path],
    *,
    seconds: float,
    docs: Path,
    decisions: Sequence[Decision] = (),
    alexnet: Path | None = None,
    int8: Path | None = None,
) -> Row:
    """Measure every file, write ``benchmark`` .md and .json into ``docs``; returns the report.

    ``int8``: folder of both released fp32 step models, which are also built in int8 and compared on ``decisions``.
    ``alexnet``: folder of the paper's networks. Raises ContractError on a bad file, or without any.
    """
    if not files:
        raise ContractError("no network to measure: expected ONNX files, or the folder models/ here")
    models = [open_model(file) for file in files]
    report: Row = {"cpu": cpu_name(), "commit": commit(), "models": []}
    print(f"{report['cpu']}, one thread")
    for model in models:
        print(f"{model.file} ...", flush=True)
        report["models"].append(measure(model, seconds))
    if int8 is not None:
        with tempfile.TemporaryDirectory() as folder:
            report["int8"] = precisions(int8, Path(folder), list(decisions) or golden_decisions(), seconds)
        report["int8_recorded"] = bool(decisions)
    if alexnet is not None:
        steps = [model for model in models if model.card.form == "step"]
        report["alexnet"] = paper.compare(steps, alexnet, 10 * seconds)
    print(publish(docs, NAME, benchmark_page(report), report))
    return report


def measure(model: Model, seconds: float) -> Row:
    """Size of a file and the cost of a call."""
    with undisturbed():
        timing, _ = time_in_turn({"": together([model])}, seconds=seconds)[""]
    size_mb = model.file.stat().st_size / 1e6
    return {"file": str(model.file), "size_mb": size_mb, **timing._asdict()}


def precisions(folder: Path, out: Path, decisions: Sequence[Decision], seconds: float) -> list[Row]:
    """One row per storage format of the weights: all step models of a folder together, as in the service.

    A refused build has its reason instead of figures. Raises ContractError for networks that give no command together,
    or that read steps of depth, which no decision here holds.
    """
    sources = [open_model(file) for file in sorted(folder.glob("*.step.onnx"))]
    roles = sorted(model.card.role for model in sources)
    if roles not in (["pair"], ["direction", "magnitude"]) or any(model.card.pressing for model in sources):
        raise ContractError(f"--int8 {folder}: expected step networks of direction and magnitude, and not of depth")
    sets, refused = {"fp32": sources}, {}
    for mode in MODES:
        try:
            sets[f"int8 {mode}"] = [
                open_model(quantise(model.file, out / mode / model.file.name, decisions[:CALIBRATION_DECISIONS], mode))
                for model in sources
            ]
        except ContractError as error:
            refused[f"int8 {mode}"] = str(error)
    calls = {name: together(models) for name, models in sets.items()}
    times = time_in_turn(calls, seconds=len(calls) * seconds, warm=True)
    rows = []
    for name, models in sets.items():
        size_mb = sum(model.file.stat().st_size for model in models) / 1e6
        shares = {"same_commands": same_commands(sources, models, decisions), "decisions": len(decisions)}
        rows.append({"precision": name, "cpu_p50_ms": times[name][0].cpu_p50_ms, "size_mb": size_mb, **shares})
    return rows + [{"precision": name, "refused": why} for name, why in refused.items()]


def golden_decisions() -> list[Decision]:
    """Decisions to calibrate and compare the int8 builds without collected data: the speed is the same."""
    return [Decision(golden_frames(Sensor.load().rectified, 8, seed), 56.0, 30.0) for seed in range(2)]
