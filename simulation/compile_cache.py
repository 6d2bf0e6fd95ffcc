"""Numba's cache for this package: one folder for every state of the compiled sources.

Numba checks only the file of the function that it loads, not those of the functions compiled into it. After an update,
an unchanged caller would keep the old physics.
"""

import contextlib
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
    """Set numba's cache, before its import, to a folder of this state.

    It lies in the environment's one, else beside the package, else, where somebody else has installed that, in the
    user's cache. Numba itself would go there too then, but without keeping states apart.
    """
    state, named = state_of(package), os.environ.get(VARIABLE)
    beside = package / "__pycache__"
    if named:
        base = Path(named)
    elif os.access(beside if beside.exists() else package, os.W_OK):
        base = beside
    else:
        users = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")  # noqa: PTH111 who has no home may import
        base = Path(users) / "tactile-insertion"
    if base.name != state:  # a child process inherits it in its environment
        os.environ[VARIABLE] = str(base / state)


def make(package: Path) -> None:
    """Make the folder that :func:`keep_apart` chooses. Raises OSError where it cannot be written."""
    keep_apart(package)
    folder = Path(os.environ[VARIABLE])
    with contextlib.suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
    if not os.access(folder, os.W_OK):
        raise OSError(f"cannot keep the compiled physics in {folder}; name a folder of yours in {VARIABLE}")
