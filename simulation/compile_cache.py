"""Where numba keeps what it compiled of this package: a folder for every state of the compiled sources.

Numba looks at the file of the function it loads, not at those of the functions that are compiled into it: after an
update, a caller that did not change would go on with the old physics.
"""

import hashlib
import os
from pathlib import Path

VARIABLE = "NUMBA_CACHE_DIR"


def state_of(package: Path) -> str:
    """Name of the folder for the sources in ``package`` as they are now; files that compile nothing do not matter."""
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        source = path.read_bytes()
        if b"njit" in source:
            digest.update(path.name.encode() + b"\0" + source)
    return f"numba-{digest.hexdigest()[:12]}"


def keep_apart(package: Path) -> None:
    """Tell numba, before it is imported: a folder inside the one the environment names, else in ``__pycache__``."""
    state, named = state_of(package), os.environ.get(VARIABLE)
    base = Path(named) if named else package / "__pycache__"
    if base.name != state:  # the environment of a child process names it already
        os.environ[VARIABLE] = str(base / state)
