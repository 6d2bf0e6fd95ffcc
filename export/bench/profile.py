"""ONNX Runtime's own profile of a graph: what it executed, on which shapes, and how long each operator took."""

import json
from pathlib import Path
from typing import Any

from export.bench.measure import example_inputs
from export.onnx.model import Model
from export.onnx.runtime import session

CALLS = 20
COSTLIEST = 8


def profile(model: Model) -> list[dict[str, Any]]:
    """Events of a few calls on golden inputs."""
    inputs = example_inputs(model)
    run = session(model.file, profile=True)
    for _ in range(CALLS):
        run.run(None, inputs)
    path = Path(run.end_profiling())
    events: list[dict[str, Any]] = json.loads(path.read_text())
    path.unlink()
    return events


def operators(events: list[dict[str, Any]]) -> dict[str, float]:
    """Mean ms a call spent in each kind of operator (wall time), costliest first."""
    spent: dict[str, float] = {}
    for event in events:
        if event.get("cat") == "Node" and str(event.get("name", "")).endswith("_kernel_time"):
            name = str(event["args"].get("op_name", "?"))
            spent[name] = spent.get(name, 0.0) + event["dur"] / 1e3 / CALLS
    return dict(sorted(spent.items(), key=lambda item: -item[1])[:COSTLIEST])
