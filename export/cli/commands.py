"""Export, verify and measure networks: ``python -m export onnx runs/compact/checkpoint.pt --out models/``."""

import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Literal

import tyro

from service.contract import ContractError


def _positive(**options: float) -> None:
    """Raise ContractError, naming the option, where a duration or budget is not a finite number above 0."""
    for name, value in options.items():
        if not 0 < value < math.inf:
            raise ContractError(f"--{name.replace('_', '-')} {value:g}: expected a finite number above 0")


def onnx(checkpoint: Annotated[Path, tyro.conf.Positional], out: Path = Path("models"), force: bool = False) -> None:
    """Write both networks in sequence and step form, each with its card, after proving parity with torch.

    Args:
        checkpoint: a ``checkpoint.pt`` of ``python -m training train``.
        out: folder of the released models.
        force: also where the directions are no better than guessed; the card's figures say so.
    """
    from export.onnx.to_onnx import export_checkpoint, why_untrained

    if (why := why_untrained(checkpoint)) and not force:
        raise ContractError(f"{checkpoint}: {why}; --force exports it all the same")
    for file in export_checkpoint(checkpoint, out):
        print(f"{file}  {file.stat().st_size / 1e6:.2f} MB")


def verify(folder: Annotated[Path, tyro.conf.Positional] = Path("models"), stream_steps: int = 10_000) -> None:
    """Check every model of a folder: card, graph, self-test, forms, batches, threads, hard inputs, a long stream.

    Args:
        folder: folder of released models.
        stream_steps: how many steps without a fresh state.
    """
    from export.onnx.verify import verify as check

    _positive(stream_steps=stream_steps)
    print("\n".join(check(folder, stream_steps)))


def quantize(
    folder: Annotated[Path, tyro.conf.Positional] = Path("models"),
    out: Path = Path("runs"),
    data: Path = Path("data/probes"),
    decisions: int = 300,
    mode: Literal["static", "dynamic", "blocked"] = "blocked",
) -> None:
    """Make int8 builds of released step models and say how many robot commands they would change.

    Args:
        folder: folder of released fp32 step models: a pair, a joint density, or both networks in one graph.
        out: folder in which int8-MODE is made.
        data: collected dataset; its training split calibrates, its validation split compares the commands.
        decisions: how many collisions are compared.
        mode: ONNX Runtime's static or dynamic int8, or weights in blocks of 16.
    """
    from export.onnx.decisions import read_split
    from export.quantise.candidates import find_candidates
    from export.quantise.quantise import CALIBRATION_DECISIONS, quantise
    from export.quantise.scores import agreements, score

    compared = read_split(str(data), "validation", decisions)
    calibrating = list(read_split(str(data), "train", CALIBRATION_DECISIONS))
    sources = find_candidates([folder])
    home = out / f"int8-{mode}"
    for model in (model for source in sources for model in source.models):
        build = quantise(model.file, home / model.file.name, calibrating, mode)
        print(f"{build}  {build.stat().st_size / 1e6:.2f} MB of {model.file.stat().st_size / 1e6:.2f}")
    candidates = [*sources, *find_candidates([home])]
    for row in agreements(candidates, score(candidates, compared)):
        print(f"{row['name']}: {row['summary']}")


def benchmark(
    models: Annotated[list[Path], tyro.conf.Positional] = [],  # noqa: B006 - tyro copies it
    seconds: float = 1.0,
    docs: Path = Path("runs/benchmark"),
    compare: str = "",
    data: Path | None = None,
    decisions: int = 64,
    alexnet: Path | None = None,
    loadgen: bool = True,
) -> None:
    """Measure models on this machine: latency, throughput, memory, threads, peers, LoadGen, accuracy.

    Args:
        models: ONNX files; all of models/ and its folders if none is named.
        seconds: how long each measurement lasts.
        docs: folder of benchmark.md, benchmark.json and benchmark.png.
        compare: runtimes to measure beside the first step model, of torch and openvino, separated by commas.
        data: collected dataset whose collisions LoadGen's accuracy mode decides on; that column is empty without one.
        decisions: how many collisions.
        alexnet: folder of the paper's networks as exported (and, with ``_shared`` after its name, behind one backbone);
            made with random weights if absent. Adds the speed claims.
        loadgen: run MLPerf LoadGen's SingleStream, Offline, Server and accuracy scenarios.
    """
    from export.bench.benchmark import benchmark as measure
    from export.bench.loadgen import available
    from export.bench.peers import known
    from export.onnx.decisions import read_split

    _positive(seconds=seconds)
    peers = known(compare)
    if loadgen and not available():
        print("LoadGen is not installed (pip package mlcommons-loadgen): its scenarios are left out", file=sys.stderr)
    recorded = list(read_split(str(data), "validation", decisions)) if data is not None else None
    measure(
        models or sorted(Path("models").rglob("*.onnx")),
        seconds=seconds,
        docs=docs,
        compare=peers,
        decisions=recorded,
        alexnet=alexnet,
        with_loadgen=loadgen and available(),
    )
    print(f"{docs / 'benchmark.md'}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; wrong input is one line on standard error and exit code 2."""
    try:
        commands: dict[str, Callable[..., None]] = {
            "onnx": onnx,
            "verify": verify,
            "quantize": quantize,
            "benchmark": benchmark,
        }
        tyro.extras.subcommand_cli_from_dict(commands, args=arguments, prog="tactile-insertion")
    except (ContractError, OSError) as error:  # a folder that cannot be written is bad input, too
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0
