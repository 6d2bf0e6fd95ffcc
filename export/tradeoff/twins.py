"""The int8 and fp16 twins of released step models, made where they are missing or older than their source."""

from functools import cached_property
from pathlib import Path

from export.onnx.decisions import DYNAMIC, KINDS, Decision, read_split
from export.quantise.quantise import CALIBRATION_DECISIONS, LARGE_BYTES, quantize, store_fp16

PRECISIONS = ("int8", DYNAMIC, "fp16")
CALIBRATING_SPLIT = "train"
"""What is scored comes from another split: no twin is judged on a collision that it was rounded for."""


def make_twins(folders: list[Path], out: Path, data: str) -> list[Path]:
    """Write ``out/<folder>/<int8|int8-dynamic|fp16>/*.step.onnx``; returns the folders that hold any.

    Calibrates on real frames of the dataset's training split. A large network has its int8 twin alone: its large layers
    are multiplied in int8 there.
    """
    homes: list[Path] = []
    calibration = _Calibration(data)
    for folder in folders:
        names = [name for names in KINDS.values() for name in names if (folder / name).is_file()]
        large = any((folder / name).stat().st_size > LARGE_BYTES for name in names)
        for precision in PRECISIONS[:1] if large else PRECISIONS:
            home = out / "-".join(part for part in folder.parts if part not in ("/", "..")) / precision
            for name in names:
                _make(folder / name, home / name, precision, calibration)
            homes.append(home)
    return homes


class _Calibration:
    """Decisions to calibrate on, drawn once, when first needed."""

    def __init__(self, data: str) -> None:
        self._data = data

    @cached_property
    def decisions(self) -> list[Decision]:
        return list(read_split(self._data, CALIBRATING_SPLIT, CALIBRATION_DECISIONS))


def _make(source: Path, twin: Path, precision: str, calibration: _Calibration) -> None:
    """Make one twin unless it is there."""
    if twin.is_file() and twin.stat().st_mtime >= source.stat().st_mtime:
        return
    unfinished = twin.with_suffix(".part")  # a killed run must not leave a half-made twin under its name
    try:
        if precision == "fp16":
            store_fp16(source, unfinished)
        else:
            quantize(source, unfinished, calibration.decisions, dynamic=precision == DYNAMIC)
        unfinished.replace(twin)
    finally:
        unfinished.unlink(missing_ok=True)
