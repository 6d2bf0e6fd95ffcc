"""Other pages' measurements, in the form that this page's figures need."""

from pathlib import Path

from reporting.files import read_json
from reporting.statistics import wilson
from service.contract.shipped import released_models
from service.contract.wire import PRESS_MM
from simulation.closed_loop.play import models_of
from simulation.closed_loop.statistics import Row

PARTS = {
    "benchmark": "make bench",
    "depths": "python -m training depths",
    "transfer": "make transfer",
    "slip_report": "python -m simulation slip-report",
}
"""What the figures read, and what makes it."""
ELSEWHERE = "finite elements"
"""The physics that no network was trained in, as its page calls it."""


def kept(docs: Path) -> Row:
    """Networks, builds, depths, transfer and slip from ``docs/*.json`` and the cards of the released networks.

    Raises ValueError where a file is missing.
    """
    bench, depths, transfer, slip = (read_json(docs / f"{name}.json", made_by) for name, made_by in PARTS.items())
    pressing = models_of(released_models()).card.pressing
    return {
        "reads_mm": round(pressing.depth_mm, 6) if pressing else None,
        "press_mm": PRESS_MM,
        "networks": [_network(row["folder"], row["cpu_p50_ms"]) for row in bench["alexnet"]["rows"]],
        "builds": [
            {
                "name": row["precision"],
                "cpu_ms": row["cpu_p50_ms"],
                "same": list(wilson(row["same_commands"], row["decisions"])),
            }
            for row in bench["int8"]
            if "refused" not in row
        ],
        "depths": {name: _right(row) for name, row in depths["depths"].items() if _of_test(name)},
        "sure": {
            name: {"saved": row["saved"], "right": _right(row)}
            for name, row in depths["sure"].items()
            if _of_test(name)
        },
        "transfer": [
            {"name": row["name"], "cpu_ms": row["cpu_ms"], "presses": row["presses"], "right": row["direction"]}
            for row in transfer["rows"]
            if row["tested_on"] == ELSEWHERE
        ],
        "slip": {
            "ms": slip["path_ms"]["median"],
            **{name: slip["slip"][name] for name in ("images", "true fields")},
        },
    }


def _of_test(name: str) -> bool:
    return name.startswith("test") and "nothing told" not in name


def _network(folder: str, cpu_ms: float) -> Row:
    card = models_of(Path(folder)).card
    reads = "markers" if card.markers else "steps of depth" if card.pressing else "pictures"
    name = f"{reads}, joint" if card.role == "joint" else reads
    return {"name": name, "deep": card.pressing is not None, "cpu_ms": cpu_ms, "right": _right(card.validation)}


def _right(row: Row) -> list[float]:
    return list(wilson(row["accuracy"] * row["trials"], int(row["trials"])))
