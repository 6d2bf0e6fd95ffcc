"""The speed claims: the released step after the last frame against the paper's two networks over a whole sequence."""

from itertools import chain
from pathlib import Path
from typing import Any

from export.bench.alexnet import files, trained
from export.bench.measure import example_inputs, quartiles, time_in_turn
from export.bench.profile import operators, profile
from export.limits import probe, work_of
from export.onnx.model import Model, open_model

SHARED = "shared backbone int8"
CLAIMS = {"released": 1 / 150, SHARED: 1 / 25}
"""At most these shares of two fp32 AlexNet sequence passes, in processor time (design, section 7)."""
PASSES = "two fp32 passes"


def ratios(steps: list[Model], folder: Path, seconds: float, data: str | None = None) -> dict[str, Any]:
    """Steps of the released networks and of AlexNet behind one backbone, over two fp32 AlexNet sequence passes.

    All are called in turn on one thread, each after an untimed call of its own; processor time, median and quartiles
    of the ratios. A released step is that of all networks of one folder, as a service runs them.
    """
    found = files(folder, data)
    homes = sorted({model.file.parent for model in steps})
    sets = {f"released: {home}": [model for model in steps if model.file.parent == home] for home in homes}
    sets[PASSES] = [open_model(found["direction"]), open_model(found["magnitude"])]
    sets |= {name: [open_model(file)] for name, file in found.items() if name.startswith("shared")}
    everything = list(chain(*sets.values()))
    peaks = probe(max(work_of(model).weight_bytes for model in sets[SHARED]))
    inputs = {id(model): example_inputs(model) for model in everything}
    calls = {name: _all(models, inputs) for name, models in sets.items()}
    rows = time_in_turn(calls, seconds=10 * seconds, least=12, warm=True)
    base = rows.pop(PASSES)
    works = {name: [work_of(model) for model in sets[name]] for name in rows}
    return {
        "trained": trained(found),
        "peaks": peaks.as_dict(),
        "passes_cpu_ms": base[0].cpu_p50_ms,
        "rows": [
            {
                "what": name,
                "files": [model.file.name for model in sets[name]],
                "cpu_p50_ms": timing.cpu_p50_ms,
                "ratio": quartiles(spent[1], base[1][1]),
                "claim": next((claim for start, claim in CLAIMS.items() if name.startswith(start)), None),
                "limit_ms": sum(work.limit_ms(peaks) for work in works[name]),
                "shaped_ms": sum(work.shaped_ms(peaks) for work in works[name]),
                "convolutions_ms": sum(work.shaped_ms(peaks, convolves=True) for work in works[name]),
            }
            for name, (timing, spent) in rows.items()
        ],
        "operators_ms": operators(profile(sets[SHARED][0])),
    }


def _all(models: list[Model], inputs: dict[int, Any]) -> Any:
    return lambda: [model(inputs[id(model)]) for model in models]
