"""`python -m simulation export-dataset`: trials for other people's tools, as LeRobot v3.0 or as MCAP."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from simulation.data.dataset import Dataset, DatasetError, slice_of
from simulation.data.progress import progress


@dataclass(frozen=True, slots=True)
class Options:
    """Export trials with their rendered frames: one LeRobot v3.0 dataset, or one MCAP file a trial."""

    source: Annotated[Path, tyro.conf.Positional]
    """Folder of a collected dataset."""
    out: Path
    """New or empty folder to write into."""
    layout: Literal["lerobot", "mcap"] = "lerobot"
    """lerobot: Parquet with embedded PNG; mcap: opens in Foxglove and Rerun."""
    first: int = 0
    """Number of the first trial."""
    count: int = 100
    """How many trials; a trial takes about 12 MB."""


def main(arguments: Sequence[str]) -> int:
    """Run the command line."""
    options = tyro.cli(Options, args=arguments, prog="tactile-insertion export-dataset")
    dataset = Dataset(options.source)
    numbers = slice_of(range(len(dataset)), options.first, options.count, options.source)
    if options.out.exists() and any(options.out.iterdir()):
        raise DatasetError(f"{options.out}: not empty; nothing is overwritten")
    options.out.mkdir(parents=True, exist_ok=True)
    with progress("trials", len(numbers)) as show:
        if options.layout == "lerobot":
            from simulation.data import lerobot

            lerobot.export(dataset, numbers, options.out, show)
        else:
            from simulation.data import mcap

            for done, number in enumerate(numbers, start=1):
                mcap.export_trial(dataset, number, options.out / f"trial-{number:06d}.mcap")
                show(done)
    print(f"{len(numbers)} trials under {options.out}")
    return 0
