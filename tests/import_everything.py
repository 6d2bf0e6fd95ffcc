"""Import every module of the product: `python -m tests.import_everything`, with 1 if one fails.

`make test-lowest` runs it where the lowest versions that pyproject.toml allows are installed.
"""

import importlib
import pkgutil
import sys
import tomllib
import traceback
from pathlib import Path

PACKAGES: list[str] = tomllib.loads(Path("pyproject.toml").read_text())["tool"]["importlinter"]["root_packages"]


def modules(package: str) -> list[str]:
    """The package and every module below it; commands, which run when they are imported, are left out."""
    walked = pkgutil.walk_packages(importlib.import_module(package).__path__, f"{package}.")
    return [package, *(module.name for module in walked if not module.name.endswith("__main__"))]


def main() -> int:
    """Import all; print each failure whole."""
    failed = 0
    names = [name for package in PACKAGES for name in modules(package)]
    for name in names:
        try:
            importlib.import_module(name)
        except Exception:
            failed += 1
            print(f"{name}:\n{traceback.format_exc()}", file=sys.stderr)
    print(f"{len(names) - failed} of {len(names)} modules import")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
