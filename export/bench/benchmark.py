"""``python -m export benchmark``: what a decision costs on this machine, in figures an engineer can act on."""

import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from export.bench import loadgen, peers
from export.bench.fresh import measure_fresh
from export.bench.measure import example_inputs, noise, quartiles, steadiness, time_calls, time_in_turn, undisturbed
from export.bench.profile import operators, profile
from export.bench.report import line, write
from export.limits import Peaks, Work, probe, work_of
from export.onnx.decisions import Decision, decided_class
from export.onnx.model import Arrays, Model, open_model
from export.onnx.runtime import session
from export.yardstick import ratios
from reporting.machine import cpu_name
from training.data.labels import class_of

BATCH = 16
SWEEP = ((1, False), (1, True), (2, False), (2, True))


def benchmark(
    files: list[Path],
    *,
    seconds: float,
    docs: Path | None,
    compare: tuple[str, ...] = (),
    decisions: list[Decision] | None = None,
    alexnet: Path | None = None,
    data: str | None = None,
    with_loadgen: bool = True,
) -> dict[str, Any]:
    """Measure every file, print one line each, write ``benchmark`` .md .json .png into ``docs``; returns the report.

    Raises ContractError on a bad file and on an unknown peer.
    """
    models = [open_model(file) for file in files]
    report: dict[str, Any] = {"cpu": cpu_name(), "seconds": seconds, "models": []}
    print(f"{report['cpu']}, one thread")
    profiles = {model.file: profile(model) for model in models}
    peaks = probe(max(work_of(model).weight_bytes for model in models), seconds=min(0.5, seconds))
    report["peaks"] = peaks.as_dict()
    for model in models:
        row = measure(model, profiles[model.file], peaks, seconds=seconds, compare=compare)
        if with_loadgen:
            row["loadgen"] = _loadgen(model, seconds, decisions or [])
        report["models"].append(row)
        print(line(row))
    if alexnet is not None:
        report["alexnet"] = ratios([model for model in models if model.card.form == "step"], alexnet, seconds, data)
    if docs is not None:
        docs.mkdir(parents=True, exist_ok=True)
        write(report, docs)
    return report


def measure(
    model: Model, profiled: list[dict[str, Any]], peaks: Peaks, *, seconds: float, compare: tuple[str, ...]
) -> dict[str, Any]:
    """Everything about one file but LoadGen's scenarios."""
    inputs, many = example_inputs(model), example_inputs(model, BATCH)
    with undisturbed():
        timing = time_calls(lambda: model(inputs), seconds=seconds, clock=time.thread_time_ns)
    steady = steadiness(lambda: model(inputs), seconds=seconds)
    crowd = time_calls(lambda: model(many), seconds=seconds / 2, least=5)
    return {
        "file": str(model.file),
        "card": model.card.model_dump(mode="json", exclude={"self_test"}),
        "size_mb": model.file.stat().st_size / 1e6,
        "single": timing.as_dict(),
        "steady": asdict(steady) | {"holds": steady.steady},
        "noise": noise(lambda: model(inputs), seconds=seconds / 2),
        "fresh": measure_fresh(model.file),
        "batch_per_s": BATCH * 1e3 / crowd.p50_ms,
        "batch_cpu_ms": crowd.cpu_p50_ms / BATCH,
        "sweep": _sweep(model.file, inputs, seconds / 4),
        "operators_ms": operators(profiled),
        "limit": _limit(work_of(model), peaks, timing.cpu_p50_ms),
        "peers": {name: _peer(name, model, seconds) for name in compare},
    }


def _limit(work: Work, peaks: Peaks, cpu_ms: float) -> dict[str, float]:
    limit_ms, shaped_ms = work.limit_ms(peaks), work.shaped_ms(peaks)
    return {
        "limit_ms": limit_ms,
        "shaped_ms": shaped_ms,
        "weights_mb": work.weight_bytes / 1e6,
        "ratio": cpu_ms / max(limit_ms, 1e-9),
        "shaped_ratio": cpu_ms / max(shaped_ms, 1e-9),
    }


def _sweep(file: Path, inputs: Arrays, seconds: float) -> list[dict[str, Any]]:
    """Threads and spinning, one after the other in turn: p50 of the wall, and the processor time of all threads."""
    runs = {(threads, spinning): session(file, threads, spinning=spinning) for threads, spinning in SWEEP}
    rows = []
    for (threads, spinning), run in runs.items():
        timing = time_calls(_call(run, inputs), seconds=seconds, least=20)
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
        "wall_ratio": quartiles(ours[1][0], theirs[1][0]),
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
