"""A run's scalars on external boards: the contents of ``log.jsonl``, epoch by epoch, also while a run continues."""

import json
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

from service.contract import ContractError

BoardName = Literal["tensorboard", "trackio"]
Write = Callable[[str, float, int], None]
"""Takes a scalar's name, its value and its epoch."""
PERIOD_S = 1.0


def lines(log: Path, *, follow: bool) -> Iterator[dict[str, Any]]:
    """Each complete line of a log; with ``follow``, future ones, too. A line that a kill cut off is left out."""
    with log.open() as file:
        while True:
            start, line = file.tell(), file.readline()
            if line.endswith("\n"):
                with suppress(json.JSONDecodeError):
                    yield json.loads(line)
            elif follow:
                file.seek(start)
                time.sleep(PERIOD_S)
            else:
                return


def show_on(board: BoardName, run: Path, *, follow: bool = False) -> int:
    """Write all scalars of a run's stages to a board; returns the number of epochs.

    Raises ContractError without a log, or where the board's package is not installed.
    """
    log = run / "log.jsonl"
    if not log.is_file():
        raise ContractError(f"{log} is missing: expected the folder of a run that has trained for an epoch")
    try:
        write, close = {"tensorboard": _tensorboard, "trackio": _trackio}[board](run)
    except ImportError as error:
        raise ContractError(f"{board} is not installed ({error.name}): pip install {board}") from error
    epochs_n = 0
    try:
        for epochs_n, line in enumerate(lines(log, follow=follow), start=1):  # noqa: B007 counted after the loop
            for name, value in line.items():
                if name not in {"stage", "epoch"}:
                    write(f"{line['stage']}/{name}", float(value), int(line["epoch"]))
    finally:
        close()
    return epochs_n


def _tensorboard(run: Path) -> tuple[Write, Callable[[], None]]:
    """Events under ``RUN/tensorboard``: ``tensorboard --logdir runs``."""
    from torch.utils.tensorboard import SummaryWriter

    board: Any = SummaryWriter(str(run / "tensorboard"))
    return board.add_scalar, board.close


def _trackio(run: Path) -> tuple[Write, Callable[[], None]]:
    """A run of the project ``tactile-insertion`` in Trackio's local store: ``trackio show``."""
    import trackio

    trackio.init(project="tactile-insertion", name=run.name, embed=False)
    return lambda name, value, epoch: trackio.log({name: value}, step=epoch), trackio.finish
