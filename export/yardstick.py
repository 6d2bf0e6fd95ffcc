"""The speed claims: the released step after the last frame against the paper's two networks over a whole sequence."""

from itertools import chain
from pathlib import Path
from typing import Any

from export.alexnet import files, trained
from export.limits import probe, work_of
from export.measure import example_inputs, quartiles, time_in_turn
from export.profile import operators, profile
from export.verify import Model, open_model

CLAIMS = {"compact": 1 / 150, "shared int8": 1 / 25}
"""At most these shares of two fp32 AlexNet sequence passes, in processor time (design, section 7)."""


def ratios(steps: list[Model], folder: Path, seconds: float) -> dict[str, Any]:
    """Steps of the released networks and of the shared int8 AlexNet pair, over two fp32 AlexNet sequence passes.

    All are called in turn on one thread, each after an untimed call of its own; processor time, median and quartiles
    of the ratios. The released step is that
    of all networks of one folder, as a service runs them.
    """
    found = files(folder)
    passes = [open_model(found["direction"]), open_model(found["magnitude"])]
    sets = {f"compact: {home}": [m for m in steps if m.file.parent == home] for home in {m.file.parent for m in steps}}
    sets |= {"two fp32 passes": passes, "shared int8 step": [open_model(found["int8"])]}
    sets |= {"shared fp32 step": [open_model(found["shared"])]}
    everything = list(chain(*sets.values()))
    profiles = {id(model): profile(model) for model in everything}
    peaks = probe(max(work_of(model).weight_bytes for model in sets["shared int8 step"]))
    inputs = {id(model): example_inputs(model) for model in everything}
    calls = {name: _all(models, inputs) for name, models in sets.items()}
    rows = time_in_turn(calls, seconds=10 * seconds, least=12, warm=True)
    base = rows["two fp32 passes"][1]
    claims = {name: _claim(name) for name in sets}
    return {
        "trained": trained(folder),
        "peaks": peaks.as_dict(),
        "passes_cpu_ms": rows["two fp32 passes"][0].cpu_p50_ms,
        "rows": [
            {
                "what": name,
                "files": [model.file.name for model in sets[name]],
                "cpu_p50_ms": timing.cpu_p50_ms,
                "ratio": quartiles(spent[1], base[1]),
                "claim": claims[name],
                "limit_ms": sum(work_of(model).limit_ms(peaks) for model in sets[name]),
                "operators_ms": operators([event for model in sets[name] for event in profiles[id(model)]]),
            }
            for name, (timing, spent) in rows.items()
            if name != "two fp32 passes"
        ],
    }


def _all(models: list[Model], inputs: dict[int, Any]) -> Any:
    return lambda: [model(inputs[id(model)]) for model in models]


def _claim(name: str) -> float | None:
    return next((claim for start, claim in CLAIMS.items() if name.startswith(start)), None)
