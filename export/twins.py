"""The int8 and fp16 twins of released step models, made where they are missing or older than their source."""

from pathlib import Path

from export.candidates import JOINT, PAIR
from export.quantize import quantize, store_fp16
from training.dataset import read_decisions

CALIBRATION_DECISIONS = 16


def make_twins(folders: list[Path], out: Path, data: str) -> list[Path]:
    """Write ``out/<folder>/<int8|fp16>/*.step.onnx``; returns the folders. Calibrates on real frames of the dataset."""
    homes = []
    frames = None
    for folder in folders:
        for precision in ("int8", "fp16"):
            home = out / "-".join(part for part in folder.parts if part not in ("/", "..")) / precision
            homes.append(home)
            for name in (name for name in (*PAIR, *JOINT) if (folder / name).is_file()):
                if _fresh(home / name, folder / name):
                    continue
                if precision == "fp16":
                    store_fp16(folder / name, home / name)
                    continue
                frames = read_decisions(data, CALIBRATION_DECISIONS) if frames is None else frames
                quantize(folder / name, home / name, frames)
    return homes


def _fresh(twin: Path, source: Path) -> bool:
    return twin.is_file() and twin.stat().st_mtime >= source.stat().st_mtime
