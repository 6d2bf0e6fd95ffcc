"""Answers that were kept: a change of the code that was not meant to change them is noticed, however small.

`KEEP=1 pytest FILE` keeps what is made now, after a change that was meant to; review what differs as any other code.
Figures are kept to six digits and compared to one part in a thousand, as processors round differently.
"""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest


def plain(made: Any) -> Any:
    """What JSON holds of it: arrays as lists, figures to six digits."""
    if isinstance(made, Mapping):
        return {str(key): plain(value) for key, value in made.items()}
    if isinstance(made, list | tuple | np.ndarray):
        return [plain(value) for value in made]
    if isinstance(made, float | np.floating):
        return float(f"{made:.6g}")
    return made.item() if isinstance(made, np.generic) else made


def agree(made: Any, kept: Any, where: str) -> None:
    if isinstance(kept, dict):
        assert made.keys() == kept.keys(), where
        for key, value in kept.items():
            agree(made[key], value, f"{where}, {key}")
    elif isinstance(kept, list):
        assert len(made) == len(kept), where
        for index, value in enumerate(kept):
            agree(made[index], value, f"{where}, {index}")
    elif isinstance(kept, float):
        assert made == pytest.approx(kept, rel=1e-3, abs=1e-5, nan_ok=True), where
    else:
        assert made == kept, where


def is_as_kept(test_file: str, name: str, made: Any) -> None:
    """Compare ``made`` with what kept.json, beside the test's file, holds under ``name``."""
    place = Path(test_file).with_name("kept.json")
    answers = json.loads(place.read_text()) if place.exists() else {}
    if os.environ.get("KEEP"):
        answers[name] = plain(made)
        lines = (f"{json.dumps(key)}: {json.dumps(value)}" for key, value in sorted(answers.items()))
        place.write_text("{\n" + ",\n".join(lines) + "\n}\n")
    agree(plain(made), answers[name], name)
