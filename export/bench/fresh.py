"""A new process that opens one model: ``python -m export.bench.fresh FILE INPUTS`` prints load, first call, memory.

The cost of a model before its first answer cannot be measured in a process that has opened it or others before. The
inputs come from outside, as ``.npz``.
"""

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from export.bench.measure import example_inputs
from export.onnx.model import open_model
from export.onnx.runtime import session
from service.contract import ContractError


def measure_fresh(file: Path) -> dict[str, float]:
    """``load_ms``, ``first_ms`` and ``peak_mb`` (beyond the interpreter and its libraries) of a model in a new process.

    Raises ContractError with the child's last line if it fails.
    """
    with tempfile.TemporaryDirectory() as folder:
        inputs = Path(folder) / "inputs.npz"
        np.savez(inputs, **example_inputs(open_model(file)))  # type: ignore[arg-type]
        command = [sys.executable, "-m", "export.bench.fresh", str(file), str(inputs)]
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
    if done.returncode != 0:
        raise ContractError(f"{file} could not be measured: {(done.stderr.strip().splitlines() or ['no output'])[-1]}")
    figures: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return figures


def _memory_mb(field: str) -> float:
    status = Path("/proc/self/status").read_text()
    return int(status.split(f"{field}:")[1].split()[0]) * 1024 / 1e6


def main(file: Path, given: Path) -> None:
    """Open, call once, print JSON."""
    with np.load(given) as stored:
        inputs = dict(stored)
    before_mb = _memory_mb("VmRSS")
    started = time.perf_counter()
    run = session(file)
    loaded = time.perf_counter()
    run.run(None, inputs)
    first = time.perf_counter()
    figures = {
        "load_ms": (loaded - started) * 1e3,
        "first_ms": (first - loaded) * 1e3,
        "peak_mb": max(0.0, _memory_mb("VmHWM") - before_mb),
    }
    print(json.dumps(figures))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
