"""The int8 and fp16 twins of released step models, made where they are missing or older than their source."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from export.candidates import KINDS, WHOLE
from export.quantize import quantize, store_fp16
from service.contract import ContractError
from training.dataset import read_decisions

CALIBRATION_DECISIONS, JUDGED_DECISIONS = 8, 120
LARGE_BYTES = 50_000_000
"""A larger network is made int8 as a whole and nothing else: choosing its layers would take an hour."""


def make_twins(folders: list[Path], out: Path, data: str) -> list[Path]:
    """Write ``out/<folder>/<int8|int8-whole|fp16>/*.step.onnx``; returns the folders that hold any.

    Calibrates on real frames of the dataset; ``int8`` holds only layers that leave the commands what they were, and is
    left out where there is none.
    """
    homes: list[Path] = []
    frames = _Frames(data)
    for folder in folders:
        for precision in ("int8", WHOLE, "fp16"):
            home = out / "-".join(part for part in folder.parts if part not in ("/", "..")) / precision
            names = [name for names in KINDS.values() for name in names if (folder / name).is_file()]
            if all(_make(folder / name, home / name, precision, frames) for name in names):
                homes.append(home)
    return homes


class _Frames:
    """Decisions to calibrate on and to judge layers by, drawn once, when first needed."""

    def __init__(self, data: str) -> None:
        self._data = data
        self._drawn: NDArray[np.uint8] | None = None

    def __call__(self) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        if self._drawn is None:
            self._drawn = read_decisions(self._data, CALIBRATION_DECISIONS + JUDGED_DECISIONS)
        every = max(1, len(self._drawn) // CALIBRATION_DECISIONS)
        calibrating = np.arange(len(self._drawn)) % every == 0
        return self._drawn[calibrating], self._drawn[~calibrating]


def _make(source: Path, twin: Path, precision: str, frames: _Frames) -> bool:
    """Make one twin unless it is there; False where this precision does not apply."""
    if twin.is_file() and twin.stat().st_mtime >= source.stat().st_mtime:
        return True
    large = source.stat().st_size > LARGE_BYTES
    if large and precision != WHOLE:
        return False
    if precision == "fp16":
        store_fp16(source, twin)
        return True
    calibrating, judged = frames()
    unfinished = twin.with_suffix(".part")  # a killed run must not leave a half-made twin under its name
    try:
        quantize(source, unfinished, calibrating, judged if precision == "int8" else None)
    except ContractError as error:
        print(f"{source}: no {precision} twin: {error}")
        unfinished.unlink(missing_ok=True)
        return False
    unfinished.replace(twin)
    return True
