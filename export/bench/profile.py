"""ONNX Runtime's own profile of a graph: how long each kind of operator took."""

import json
from pathlib import Path

from export.bench.measure import example_inputs
from export.onnx.model import Model
from export.onnx.runtime import session

CALLS = 20
COSTLIEST = 8


def operators(model: Model) -> dict[str, float]:
    """Mean ms a call spends in each kind of operator (wall time) on golden inputs, costliest first."""
    inputs = example_inputs(model)
    run = session(model.file, profile=True)
    for _ in range(CALLS):
        run.run(None, inputs)
    path = Path(run.end_profiling())
    spent: dict[str, float] = {}
    for event in json.loads(path.read_text()):
        if event.get("cat") == "Node" and str(event.get("name", "")).endswith("_kernel_time"):
            name = str(event["args"].get("op_name", "?"))
            spent[name] = spent.get(name, 0.0) + event["dur"] / 1e3 / CALLS
    path.unlink()
    return dict(sorted(spent.items(), key=lambda item: -item[1])[:COSTLIEST])
