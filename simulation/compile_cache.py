"""Numba's cache for this package: one folder for every state of the compiled sources.

Numba checks only the file of the function that it loads, not those of the functions compiled into it. After an update,
an unchanged caller would keep the old physics.
"""

import hashlib
import os
from pathlib import Path

VARIABLE = "NUMBA_CACHE_DIR"


def state_of(package: Path) -> str:
    """Name of the folder for the present sources in ``package``; files that compile nothing do not count."""
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        source = path.read_bytes()
        if b"njit" in source:
            digest.update(path.name.encode() + b"\0" + source)
    return f"numba-{digest.hexdigest()[:12]}"


def keep_apart(package: Path) -> None:
    """Set numba's cache, before its import, to a folder inside the environment's one, else in ``__pycache__``."""
    state, named = state_of(package), os.environ.get(VARIABLE)
    base = Path(named) if named else package / "__pycache__"
    if base.name != state:  # a child process inherits it in its environment
        os.environ[VARIABLE] = str(base / state)
