"""Export, verify and measure networks: ``python -m export onnx runs/compact/checkpoint.pt --out models/``."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from service.contract import ContractError
from service.contract.text import fitted
from training.cli.commands import run_one_of


def _positive(**options: float) -> None:
    """Raise ContractError, naming the option, if a duration or budget is not a finite number above 0."""
    for name, value in options.items():
        if not 0 < value < math.inf:
            raise ContractError(f"--{name.replace('_', '-')} {value:g}: expected a finite number above 0")


def onnx(checkpoint: Annotated[Path, tyro.conf.Positional], out: Path, force: bool = False) -> None:
    """Write both networks in sequence and step form, each with its card, after checking parity with torch.

    Args:
        checkpoint: a ``checkpoint.pt`` of ``python -m training train``.
        out: folder of the files; those of the same names are replaced.
        force: export even if the directions are no better than guessing; the card says so.
    """
    from export.onnx.to_onnx import export_checkpoint, why_untrained
    from training.fit.checkpoint import Checkpoint

    if not force and (why := why_untrained(Checkpoint.load(checkpoint))):
        raise ContractError(f"{checkpoint}: {why}; --force exports it all the same")
    for file in export_checkpoint(checkpoint, out):
        print(f"{file}  {file.stat().st_size / 1e6:.2f} MB")


def verify(folder: Annotated[Path, tyro.conf.Positional] = Path("models"), stream_steps: int = 10_000) -> None:
    """Check every model of a folder: card, graph, self-test, forms, batches, threads, hard inputs, a long stream.

    Args:
        folder: folder of released models.
        stream_steps: number of steps without resetting the state.
    """
    from export.onnx.verify import verify as check

    _positive(stream_steps=stream_steps)
    print("\n".join(fitted(line, 2) for line in check(folder, stream_steps)))


def benchmark(
    models: Annotated[list[Path], tyro.conf.Positional] = [],  # noqa: B006 - tyro copies it
    seconds: float = 1.0,
    docs: Path = Path("runs/benchmark"),
    data: Path | None = None,
    int8: Path | None = None,
    alexnet: Path | None = None,
) -> None:
    """Measure models on this machine: latency, whether int8 pays, and the paper's networks for comparison.

    Args:
        models: ONNX files; default: all in models/ and its folders.
        seconds: duration of each measurement.
        docs: folder of benchmark.md and benchmark.json.
        data: collected dataset on whose collisions int8 is calibrated and compared; default: golden frames.
        int8: folder of released step models that are also built in int8.
        alexnet: folder of the paper's exported networks; created with random weights if absent.
    """
    from export.bench.benchmark import benchmark as measure
    from export.onnx.decisions import read_validation

    _positive(seconds=seconds)
    files = models or [file for file in sorted(Path("models").rglob("*.onnx")) if "/." not in str(file)]
    recorded = list(read_validation(str(data))) if data is not None else []
    measure(files, seconds=seconds, docs=docs, decisions=recorded, alexnet=alexnet, int8=int8)
    print(f"{docs / 'benchmark.md'}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; invalid input gives one line on standard error and exit code 2."""
    return run_one_of({"onnx": onnx, "verify": verify, "benchmark": benchmark}, arguments, "export")
