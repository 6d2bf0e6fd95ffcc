"""Export, verify and measure networks: ``python -m export onnx runs/compact/checkpoint.pt --out models/``."""

import sys
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


def main() -> None:
    """Command line entry."""
    try:
        tyro.extras.subcommand_cli_from_dict({"onnx": onnx, "verify": verify}, prog="python -m export")
    except ContractError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
