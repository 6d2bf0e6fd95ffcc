"""Statistics of closed-loop results; nothing here plays insertions or draws figures."""

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

Row = dict[str, Any]

FAILED_COUNTS_AS = 16
SIGNS: Mapping[str, tuple[int, int]] = {
    "1": (-1, 0), "2": (1, 0), "3": (-1, 1), "4": (-1, -1), "5": (1, 1),
    "6": (1, -1), "7": (0, -1), "8": (0, 1), "near": (0, 0),
}  # fmt: skip
"""Signs of the error in x and yaw of each class."""


def title_of(scene: str) -> str:
    """Name of an object from a row, which has its name or the path of its file."""
    return Path(scene).stem


def trials_of(row: Row) -> int:
    """Attempts of an insertion, a failure counted as the paper does."""
    return int(row["attempts"]) if row["inserted"] else FAILED_COUNTS_AS


def class_of(x_mm: float, theta_deg: float) -> str:
    """The error class of a true error."""
    signs = (_sign(x_mm, 2.5), _sign(theta_deg, 5.0))
    return next(name for name, pair in SIGNS.items() if pair == signs)


def _sign(value: float, threshold: float) -> int:
    return 0 if abs(value) <= threshold else int(math.copysign(1, value))


def first_decisions(rows: Iterable[Row]) -> list[Row]:
    """The first trial of each insertion that began with a correction."""
    firsts = (row["trials"][0] for row in rows if row["trials"])
    return [trial for trial in firsts if trial["decision"]["type"] == "correction"]


def claimed_wrongly(row: Row) -> bool:
    """Whether the client claimed an insertion that was none."""
    return bool(row["claimed"] and not row["inserted"])


def refused(row: Row) -> bool:
    """Whether the service or the client ended the insertion by itself before its trials were used up."""
    return not (row["inserted"] or row["claimed"] or row["void"]) and row["attempts"] < FAILED_COUNTS_AS - 1


def ends(rows: Sequence[Row]) -> Row:
    """How insertions ended, counted; a failure counts as 16 trials."""
    return {
        "insertions": len(rows),
        "inserted": sum(row["inserted"] for row in rows),
        "claimed_wrongly": sum(map(claimed_wrongly, rows)),
        "refused": sum(refused(row) for row in rows),
        "void": sum(row["void"] for row in rows),
        "mean_trials": sum(trials_of(row) for row in rows) / len(rows),
    }
