"""What the camera's rate and the arm's speed change: the same descents at several rates, and slow and quick ones."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from reporting.statistics import Estimate, mean, wilson
from reporting.table import Table, table
from training.data.dataset import Source
from training.data.descents import WIDEST_SPACING_MM, speed_of
from training.data.pressed import Pressed, table_of
from training.fit.train import Trainer
from training.metrics.figures import Predictions, Scales, figures
from training.report.transfer import points

Row = dict[str, Any]
RATES_FPS = (30.0, 60.0, 90.0)
SPEEDS_MM_S = {"3.5 to 7 mm/s": (3.5, 7.0), "7 to 14 mm/s": (7.0, 14.0), "18 to 35 mm/s": (18.0, 35.0)}
MOST = 4000


def by_camera(trainer: Trainer, scales: Scales, source: Source) -> list[Row]:
    """Figures of the held-out test presses read at each rate, then of those at each speed, read at 60 frames/s.

    Presses too quick for the lowest rate are left out of all rates, so that all rows of these read the same presses.
    Empty for a dataset without test presses.
    """
    chosen, speed_mm_s = _test_presses(source)
    slow = chosen[speed_mm_s < WIDEST_SPACING_MM * RATES_FPS[0]]
    rows, first = list[Row](), None
    for fps in RATES_FPS if len(slow) else ():
        predictions = _read(trainer, scales, source, slow, fps)
        right = predictions.right.astype(float)
        first = right if first is None else first
        rows.append(_row(f"{fps:.0f} frames/s", predictions, mean((right - first).tolist())))
    for name, (low, high) in SPEEDS_MM_S.items():
        within = chosen[(speed_mm_s >= low) & (speed_mm_s < high)]
        if len(within):
            rows.append(_row(name, _read(trainer, scales, source, within, 60.0)))
    return rows


def _test_presses(source: Source) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Numbers and speeds of the first test presses."""
    presses: list[tuple[int, float]] = []
    for index in track(range(len(source)), "reading speeds", transient=True):
        trial = source.trial(index)
        if trial.split == "test":
            presses.append((index, speed_of(trial)))
        if len(presses) == MOST:
            break
    return np.array([index for index, _ in presses], np.int64), np.array([speed for _, speed in presses])


def _read(trainer: Trainer, scales: Scales, source: Source, chosen: NDArray[np.int64], fps: float) -> Predictions:
    held = trainer.trials
    assert isinstance(held, Pressed)
    presses = replace(held, **table_of(source, chosen.tolist(), 1, fps))
    return replace(trainer, trials=presses).predict(np.arange(len(presses)), pictures=False).rescaled(scales)


def _row(name: str, predictions: Predictions, gained: Estimate | None = None) -> Row:
    return {"read": name, "gained": None if gained is None else list(gained), **figures(predictions)}


def camera_table(rows: list[Row]) -> Table:
    """The rows of `by_camera` as a table."""
    return table(
        rows,
        ("read", "read"),
        ("decisions", "trials", ".0f"),
        ("direction", lambda row: wilson(row["accuracy"] * row["trials"], int(row["trials"])), ".1%"),
        ("against 30 frames/s", lambda row: points(row["gained"]) if row["gained"] else "-"),
        ("MAE x mm", "mae_x_mm", ".2f"),
        ("MAE yaw deg", "mae_theta_deg", ".2f"),
        ("90 % coverage x", "coverage90_x", ".1%"),
        ("90 % coverage yaw", "coverage90_theta", ".1%"),
    )
