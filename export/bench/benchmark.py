"""``python -m export benchmark``: what a decision costs on this machine, in figures an engineer can act on."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from export.bench import loadgen, paper, peers
from export.bench.fresh import measure_fresh
from export.bench.measure import example_inputs, noise, quartiles, tails, time_calls, time_in_turn, undisturbed
from export.bench.profile import operators
from export.bench.report import write
from export.onnx.decisions import Decision, decided_class
from export.onnx.golden import golden_frames
from export.onnx.model import Arrays, Model, open_model
from export.onnx.runtime import session
from reporting.machine import commit, cpu_name
from service.contract import Sensor
from training.data.labels import class_of

BATCH = 16
SWEEP = ((1, False), (1, True), (2, False), (2, True))


def benchmark(
    files: Sequence[Path],
    *,
    seconds: float,
    docs: Path,
    compare: Sequence[str] = (),
    decisions: list[Decision] | None = None,
    alexnet: Path | None = None,
    with_loadgen: bool = True,
) -> dict[str, Any]:
    """Measure every file, print the page, write ``benchmark`` .md .json .png into ``docs``; returns the report.

    Raises ContractError on a bad file and on an unknown peer.
    """
    models = [open_model(file) for file in files]
    report: dict[str, Any] = {"cpu": cpu_name(), "commit": commit(), "seconds": seconds, "models": []}
    print(f"{report['cpu']}, one thread")
    for model in models:
        print(f"{model.file} ...", flush=True)
        row = measure(model, seconds=seconds)
        if with_loadgen:
            row["loadgen"] = _loadgen(model, seconds, decisions or [])
        report["models"].append(row)
    steps = [model for model in models if model.card.form == "step"]
    if compare:
        model = (steps or models)[0]
        rows = {name: _peer(name, model, seconds) for name in compare}
        report["peers"] = {"file": str(model.file), "rows": rows}
    if alexnet is not None:
        report["alexnet"] = paper.compare(steps, alexnet, decisions or _golden_decisions(), seconds)
    print(write(report, docs))
    return report


def measure(model: Model, *, seconds: float) -> dict[str, Any]:
    """Everything about one file but LoadGen's scenarios."""
    inputs, many = example_inputs(model), example_inputs(model, BATCH)
    with undisturbed():
        timing = time_calls(lambda: model(inputs), seconds=seconds, clock=time.thread_time_ns)
    crowd = time_calls(lambda: model(many), seconds=seconds / 2, least=5)
    return {
        "file": str(model.file),
        "card": model.card.model_dump(mode="json", exclude={"self_test"}),
        "size_mb": model.file.stat().st_size / 1e6,
        "single": timing.as_dict(),
        "steady": tails(lambda: model(inputs), seconds=seconds),
        "noise": noise(lambda: model(inputs), seconds=seconds / 2),
        "fresh": measure_fresh(model.file),
        "batch_per_s": BATCH * 1e3 / crowd.p50_ms,
        "batch_cpu_ms": crowd.cpu_p50_ms / BATCH,
        "sweep": _sweep(model.file, inputs, seconds / 4),
        "operators_ms": operators(model),
    }


def _sweep(file: Path, inputs: Arrays, seconds: float) -> list[dict[str, Any]]:
    """Threads and spinning, one after the other in turn: p50 of the wall, and the processor time of all threads."""
    rows = []
    for threads, spinning in SWEEP:
        timing = time_calls(_call(session(file, threads, spinning=spinning), inputs), seconds=seconds, least=20)
        rows.append(
            {"threads": threads, "spinning": spinning, "p50_ms": timing.p50_ms, "cpu_p50_ms": timing.cpu_p50_ms}
        )
    return rows


def _call(run: Any, inputs: Arrays) -> Callable[[], Any]:
    return lambda: run.run(None, inputs)


def _peer(name: str, model: Model, seconds: float) -> dict[str, Any]:
    """A peer against ONNX Runtime, call by call in turn; or why it could not be measured."""
    try:
        other = peers.peer(name, model)
    except peers.PeerAbsentError as error:
        return {"absent": str(error)}
    inputs = example_inputs(model)
    rows = time_in_turn({"ours": lambda: model(inputs), "theirs": other}, seconds=seconds)
    ours, theirs = rows["ours"], rows["theirs"]
    return {
        "p50_ms": theirs[0].p50_ms,
        "cpu_p50_ms": theirs[0].cpu_p50_ms,
        "ours_p50_ms": ours[0].p50_ms,
        "ours_cpu_p50_ms": ours[0].cpu_p50_ms,
        "cpu_ratio": quartiles(ours[1][1], theirs[1][1]),
    }


def _loadgen(model: Model, seconds: float, decisions: list[Decision]) -> dict[str, Any]:
    """LoadGen's scenarios and, where there are decisions, its accuracy mode in the same run."""
    results: dict[str, Any] = {
        scenario: loadgen.run_scenario(model, scenario, seconds=seconds) for scenario in loadgen.SCENARIOS
    }
    if decisions:
        labels = [int(class_of(decision.truth[None])[0]) for decision in decisions]
        right, count = loadgen.run_accuracy(lambda index: decided_class(model, decisions[index]), labels)
        results["accuracy"] = {"right": right, "decisions": count}
    return results


def _golden_decisions() -> list[Decision]:
    """What calibrates the int8 builds where no collected data is named: the speed is the same."""
    truth = np.zeros(2, np.float32)
    return [Decision(golden_frames(Sensor.load().rectified, 8, seed), 56.0, 30.0, truth, "golden") for seed in range(2)]
