"""Export, verify and measure networks: ``python -m export onnx runs/compact/checkpoint.pt --out models/``."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import tyro

from service.contract import ContractError


def onnx(checkpoint: Annotated[Path, tyro.conf.Positional], out: Path = Path("models")) -> None:
    """Write both networks in sequence and step form, each with its card, after proving parity with torch.

    Args:
        checkpoint: a ``checkpoint.pt`` of ``python -m training train``.
        out: folder of the released models.
    """
    from export.to_onnx import export_checkpoint

    for file in export_checkpoint(checkpoint, out):
        print(f"{file}  {file.stat().st_size / 1e6:.2f} MB")


def verify(folder: Annotated[Path, tyro.conf.Positional] = Path("models")) -> None:
    """Check every model of a folder: card, graph, forms, batches, threads, hard inputs.

    Args:
        folder: folder of released models.
    """
    from export.verify import verify as check

    print("\n".join(check(folder)))


def quantize(
    folder: Annotated[Path, tyro.conf.Positional] = Path("models"),
    out: Path = Path("runs/int8"),
    data: Path = Path("data/probes"),
    decisions: int = 200,
) -> None:
    """Make the int8 twins of the released pair and say how many robot commands they would change.

    Args:
        folder: folder of the released fp32 pair.
        out: folder of the int8 pair.
        data: collected dataset; 16 decisions calibrate, the rest are compared.
        decisions: how many decisions to read.
    """
    from export.quantize import agreement
    from export.quantize import quantize as shrink
    from export.verify import open_model
    from training.dataset import read_decisions

    frames = read_decisions(str(data), decisions)
    names = ("direction.step.onnx", "magnitude.step.onnx")
    pairs = [(open_model(folder / name), open_model(shrink(folder / name, out / name, frames[:16]))) for name in names]
    print(agreement(pairs[0], pairs[1], frames[16:]))


def benchmark(
    models: Annotated[list[Path], tyro.conf.Positional] = [],  # noqa: B006 - tyro copies it
    seconds: float = 2.0,
    out: Path | None = Path("runs/benchmark.json"),
    loadgen: bool = False,
) -> None:
    """Measure models on this machine: latency, throughput, operators, threads; optionally under MLPerf LoadGen.

    Args:
        models: ONNX files; all of models/ if none is named.
        seconds: how long each measurement lasts.
        out: JSON file of the results.
        loadgen: also run LoadGen's SingleStream, Offline and Server scenarios.
    """
    from export.benchmark import benchmark as measure

    measure(models or sorted(Path("models").glob("*.onnx")), seconds=seconds, out=out, with_loadgen=loadgen)


def tradeoff(
    folders: Annotated[list[Path], tyro.conf.Positional] = [],  # noqa: B006 - tyro copies it
    data: Path = Path("data/probes"),
    split: str = "validation",
    decisions: int = 300,
    docs: Path = Path("docs"),
    twins: Path = Path("runs/twins"),
    seconds: float = 3.0,
) -> None:
    """Write docs/tradeoff.md, .json and .png: accuracy against time of networks, slip trackers and physics settings.

    Args:
        folders: folders of exported fp32 step models (a pair, a joint density or both); models and models/joint if none
            is named. An ``evaluation.json`` in a folder adds its mean trials of a closed loop.
        data: collected dataset.
        split: trials on which the networks are scored: validation, or test (held-out ranges).
        decisions: how many collisions of the split.
        docs: where the report goes, and where slip_report.json, accuracy.json and closed_loop.json are read.
        twins: folder of the int8 and fp16 twins that are made and scored beside each network.
        seconds: how long each network is timed.
    """
    from export.candidates import read_split
    from export.tradeoff import tradeoff as measure
    from export.twins import make_twins

    named = folders or [Path("models"), Path("models/joint")]
    every = named + make_twins(named, twins, str(data))
    measure(every, read_split(str(data), split, decisions), split, docs, seconds)
    print(f"{docs / 'tradeoff.md'}")


def choose(budget_ms: float, report: Path = Path("docs/tradeoff.json"), seconds: float = 2.0) -> None:
    """Name the most accurate network whose step after the last frame keeps a budget on this machine.

    Args:
        budget_ms: milliseconds a step may take, p99.
        report: JSON of `python -m export tradeoff`, for the accuracies; times are taken now.
        seconds: how long each network is timed.
    """
    from export.tradeoff import choose as pick

    print(pick(budget_ms, report, seconds))


def main() -> None:
    """Command line entry."""
    try:
        commands: dict[str, Callable[..., None]] = {
            "onnx": onnx,
            "verify": verify,
            "quantize": quantize,
            "benchmark": benchmark,
            "tradeoff": tradeoff,
            "choose": choose,
        }
        tyro.extras.subcommand_cli_from_dict(commands, prog="python -m export")
    except ContractError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
