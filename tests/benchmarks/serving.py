"""`python -m tests.benchmarks.serving` (`make bench-serving`): what serving costs, in one run.

Rows: WebSocket decision against in-process; the first decision after ready; cameras at 2 x 60 and 2 x 90 fps; /healthz
under full load; age of results at twice the load this machine can take; several cells on this machine; recordings and
an adaptation, from which a fleet is worked out. Writes docs/serving.md and .json, and says where a target is missed.
"""

import argparse
import contextlib
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from reporting.machine import machine
from reporting.page import publish
from reporting.statistics import percentiles
from service.decision.models import load_models
from tests.benchmarks.cell import SteppedCell, in_process_ms
from tests.benchmarks.fleet import fleet
from tests.benchmarks.load import cells, flood, healthz_ms, overload
from tests.service.process import service_process


def quantiles(values: list[float]) -> dict[str, float]:
    p50, p99 = percentiles(values, 50, 99)
    return {"p50_ms": round(p50, 2), "p99_ms": round(p99, 2), "most_ms": round(max(values), 2), "n": len(values)}


@contextlib.contextmanager
def stepped_service(models: Path) -> Iterator[SteppedCell]:
    """A fresh service process in front of stepped cameras."""
    with tempfile.TemporaryDirectory() as folder, SteppedCell() as cell:
        options = cell.options(Path(folder))
        with service_process(models, Path(folder) / "r", *options) as cell.service:
            yield cell


def decisions(models: Path, trials: int) -> dict[str, Any]:
    """The same decision over the WebSocket and in process, in turn, so that the machine's noise meets both alike."""
    loaded = load_models(models)
    over, within, lost = [], [], 0
    with stepped_service(models) as cell:
        in_process_ms(loaded)
        for _ in range(trials):
            try:
                over.append(cell.decision_ms())
            except RuntimeError:
                lost += 1  # this machine was too busy to see eight frames of it
            within.append(in_process_ms(loaded))
    facts = {"websocket": quantiles(over), "in_process": quantiles(within), "trials_lost": lost}
    first = over[0] / float(np.median(over[1:]))
    return facts | {
        "ratio_p50": ratio(facts["websocket"], facts["in_process"]),
        "ratio_fastest_tenth": round(float(np.percentile(over, 10) / np.percentile(within, 10)), 3),
        "first_over_steady_one_start": round(first, 3),
    }


def first_decision(models: Path, starts: int, steady: int) -> dict[str, Any]:
    """The first decision of a fresh process against the median of the next ones of that same process."""
    ratios = []
    for _ in range(starts):
        with stepped_service(models) as cell:
            try:
                times = [cell.decision_ms() for _ in range(1 + steady)]
            except RuntimeError:
                continue
        ratios.append(times[0] / float(np.median(times[1:])))
    facts = {"ratios": sorted(round(r, 2) for r in ratios), "steady_n": steady}
    return facts | {"median": round(float(np.median(ratios)), 3) if ratios else None}


def ratio(of: dict[str, float], to: dict[str, float]) -> float:
    return round(of["p50_ms"] / to["p50_ms"], 3)


def arguments(given: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", type=Path, default=Path("models"))
    parser.add_argument("--trials", type=int, default=30, help="decisions over the WebSocket")
    parser.add_argument("--seconds", type=float, default=20.0, help="of each closed loop")
    parser.add_argument("--recordings", type=Path, help="folder of recorded insertions, for what a fleet costs")
    parser.add_argument("--docs", type=Path, default=Path("docs"))
    parser.add_argument(
        "--only", nargs="*", default=[], help="names of parts; the others keep what docs/serving.json has"
    )
    return parser.parse_args(given)


def main() -> int:
    from tests.benchmarks.serving_report import serving_page

    options = arguments()
    parts: dict[str, Callable[[], dict[str, Any]]] = {
        "websocket": lambda: decisions(options.models, options.trials),
        "first": lambda: first_decision(options.models, starts=9, steady=5),
        "cameras 60": lambda: flood(options.models, 60.0, options.seconds),
        "cameras 90": lambda: flood(options.models, 90.0, options.seconds),
        "health": lambda: healthz_ms(options.models, options.seconds),
        "overload": lambda: overload(options.models),
        **{f"cells {n}": lambda n=n: cells(options.models, n, 30.0, options.seconds) for n in (1, 2, 4)},
        "fleet": lambda: fleet(options.recordings),
    }
    out = options.docs / "serving.json"
    facts: dict[str, Any] = json.loads(out.read_text()) if out.is_file() and options.only else {}
    for name, measure in parts.items():
        if options.only and name not in options.only:
            continue
        print(f"{name} ...", flush=True)
        started = time.monotonic()
        try:
            figures = measure()
        except (RuntimeError, OSError, httpx.HTTPError, subprocess.SubprocessError) as error:
            figures = {"failed": f"{type(error).__name__}: {error}"[:500]}
        facts[name] = figures | {"load": round(os.getloadavg()[0], 1), "took_s": round(time.monotonic() - started)}
        print(json.dumps(facts[name]), flush=True)
        facts["machine"] = machine()
        publish(options.docs, "serving", serving_page(facts), facts)
    print(serving_page(facts))
    return 0


if __name__ == "__main__":
    threading.excepthook = lambda _: None  # cameras whose service ended
    sys.exit(main())
