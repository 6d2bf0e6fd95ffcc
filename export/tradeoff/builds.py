"""int8 and fp16 builds of released step models, made where they are missing or older than their source."""

from functools import cached_property
from pathlib import Path

from export.onnx.decisions import KINDS, Decision, read_split
from export.quantise.quantise import CALIBRATION_DECISIONS, MODES, FarOffError, Mode, quantise, store_fp16

PRECISIONS: dict[str, Mode | None] = {**{f"int8-{mode}": mode for mode in MODES}, "fp16": None}
"""Folder of each build by its quantisation mode; fp16 has none."""
CALIBRATION_SPLIT = "train"
"""Scores come from another split: no build is compared on a collision that calibrated it."""


def make_builds(folders: list[Path], out: Path, data: str) -> tuple[list[Path], list[str]]:
    """Write ``out/<folder>/<int8-...|fp16>/*.step.onnx``; returns their folders, and why a mode was refused.

    Calibrates on frames of the dataset's training split.
    """
    made, refused = list[Path](), list[str]()
    calibration = _Calibration(data)
    for folder in folders:
        names = [name for names in KINDS.values() for name in names if (folder / name).is_file()]
        for precision, mode in PRECISIONS.items():
            home = out / "-".join(part for part in folder.parts if part not in ("/", "..")) / precision
            try:
                for name in names:
                    _make(folder / name, home / name, mode, calibration)
                made.append(home)
            except FarOffError as error:
                refused.append(f"{folder} {precision}: {error}")
    return made, refused


class _Calibration:
    """Decisions to calibrate on, drawn once, when first needed."""

    def __init__(self, data: str) -> None:
        self._data = data

    @cached_property
    def decisions(self) -> list[Decision]:
        return list(read_split(self._data, CALIBRATION_SPLIT, CALIBRATION_DECISIONS))


def _make(source: Path, build: Path, mode: Mode | None, calibration: _Calibration) -> None:
    """Make one build unless it is there."""
    if build.is_file() and build.stat().st_mtime >= source.stat().st_mtime:
        return
    unfinished = build.with_suffix(".part")  # a killed run must not leave half a build under its name
    try:
        if mode is None:
            store_fp16(source, unfinished)
        else:
            quantise(source, unfinished, calibration.decisions, mode)
        unfinished.replace(build)
    finally:
        unfinished.unlink(missing_ok=True)
