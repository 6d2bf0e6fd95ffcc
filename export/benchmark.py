"""``python -m export benchmark``: what a decision costs on this machine, in figures an engineer can act on."""

import json
import time
from pathlib import Path
from typing import Any

from export import loadgen
from export.measure import example_inputs, peak_memory_mb, time_calls
from export.runtime import cpu_name, session
from export.verify import Model, open_model


def benchmark(files: list[Path], *, seconds: float, out: Path | None, with_loadgen: bool) -> list[dict[str, Any]]:
    """Measure every file; prints one table, writes ``out`` as JSON. Raises ContractError on a bad file."""
    rows = []
    print(f"{cpu_name()}, one thread; ms\n{'model':28}{'p50':>8}{'p90':>8}{'p99':>8}{'p99.9':>8}{'CPU p50':>9}", end="")
    print(f"{'CPU p99':>9}{'first':>8}{'batch 16/s':>12}{'MB':>7}")
    for file in files:
        row = measure(file, seconds=seconds)
        rows.append(row)
        timing = row["single"]
        cells = [timing[name] for name in ("p50_ms", "p90_ms", "p99_ms", "p999_ms")]
        print(f"{file.name:28}" + "".join(f"{cell:8.2f}" for cell in cells), end="")
        print(f"{timing['cpu_p50_ms']:9.2f}{timing['cpu_p99_ms']:9.2f}{row['first_ms']:8.1f}", end="")
        print(f"{row['offline_per_s']:12.0f}{row['size_mb']:7.2f}" + ("  (noisy machine)" if row["noisy"] else ""))
        if with_loadgen:
            row["loadgen"] = _loadgen(open_model(file), seconds, timing["p50_ms"])
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(json.dumps({"cpu": cpu_name(), "models": rows}, indent=1))
    return rows


def measure(file: Path, *, seconds: float) -> dict[str, Any]:
    """Latency, throughput, first inference, memory and the costliest operators of one file."""
    began = time.perf_counter()
    model = open_model(file)
    inputs = example_inputs(model)
    loaded = time.perf_counter()
    model(inputs)
    first_ms = (time.perf_counter() - loaded) * 1e3
    timing = time_calls(lambda: model(inputs), seconds=seconds)
    many = example_inputs(model, 16)
    crowd = time_calls(lambda: model(many), seconds=seconds / 2, least=5)
    return {
        "file": file.name,
        "card": model.card.model_dump(mode="json"),
        "single": timing.as_dict(),
        "noisy": timing.noisy,
        "load_ms": (loaded - began) * 1e3,
        "first_ms": first_ms,
        "offline_per_s": 16e3 / crowd.p50_ms,
        "threads": {str(threads): _threads(file, inputs, threads, seconds / 4) for threads in (1, 2)},
        "operators_ms": _operators(file, inputs),
        "size_mb": file.stat().st_size / 1e6,
        "peak_memory_mb": peak_memory_mb(),
    }


def _threads(file: Path, inputs: dict[str, Any], threads: int, seconds: float) -> dict[str, float]:
    run = session(file, threads)
    spun = session(file, threads, spinning=True)
    return {
        "p50_ms": time_calls(lambda: run.run(None, inputs), seconds=seconds).p50_ms,
        "spinning_p50_ms": time_calls(lambda: spun.run(None, inputs), seconds=seconds).p50_ms,
    }


def _operators(file: Path, inputs: dict[str, Any], calls: int = 30) -> dict[str, float]:
    """Mean ms a call spent in each kind of operator, costliest first, from ONNX Runtime's profiler."""
    run = session(file, profile=True)
    for _ in range(calls):
        run.run(None, inputs)
    path = Path(run.end_profiling())
    events = json.loads(path.read_text())
    path.unlink()
    spent: dict[str, float] = {}
    for event in events:
        if event.get("cat") == "Node" and str(event.get("name", "")).endswith("_kernel_time"):
            name = str(event["args"].get("op_name", "?"))
            spent[name] = spent.get(name, 0.0) + event["dur"] / 1e3 / calls
    return dict(sorted(spent.items(), key=lambda item: -item[1])[:8])


def _loadgen(model: Model, seconds: float, expected_ms: float) -> dict[str, dict[str, str]]:
    results: dict[str, dict[str, str]] = {}
    for scenario in loadgen.SCENARIOS:
        summary = loadgen.run_scenario(model, scenario, seconds=seconds, expected_ms=expected_ms)
        results[scenario] = summary
        keys = ("Result is", "90.00 percentile latency (ns)", "99.00 percentile latency (ns)", "Samples per second")
        print(f"  LoadGen {scenario}: " + ", ".join(f"{key} {summary[key]}" for key in keys if key in summary))
    return results
