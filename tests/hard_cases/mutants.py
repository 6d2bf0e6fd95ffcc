"""Does the suite bite? Take a guard away in a copy of the repository: its case must fail there."""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.hard_cases.registry import ROOT, Case
from tests.hard_cases.suite import CASES

MUTANTS = [case.name for case in CASES.values() if case.guard.mutant is not None]
COPIED = ("simulation", "training", "export", "service", "robot_client", "tests", "models", "pyproject.toml")
PROBE = """
import sys
from tests.hard_cases.registry import run
from tests.hard_cases.suite import CASES
sys.exit(0 if run(CASES[{name!r}]).passed else 17)
"""


def survives(case: Case, scratch: Path) -> bool:
    """Whether the case still holds without its guard; raises RuntimeError if it could not be tried."""
    copy = copied(scratch)
    path = copy / case.guard.file
    original = path.read_text()
    assert case.guard.mutant is not None
    path.write_text(original.replace(case.guard.text, case.guard.mutant, 1))
    try:
        code = PROBE.format(name=case.name)
        environment = os.environ | {"PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"}
        done = subprocess.run(
            [sys.executable, "-c", code],
            cwd=copy,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
            timeout=600,
        )
    finally:
        path.write_text(original)
    if done.returncode not in (0, 17):
        raise RuntimeError(f"{case.name} could not be tried without its guard: {done.stderr[-400:]}")
    return done.returncode == 0


def bitten(name: str) -> bool:
    """Whether the case fails once its guard is gone; for a worker process."""
    with tempfile.TemporaryDirectory() as scratch:
        return not survives(CASES[name], Path(scratch))


def copied(scratch: Path) -> Path:
    """A copy of what the cases need, made once in ``scratch``; models are linked."""
    copy = scratch / "repository"
    if not copy.exists():
        copy.mkdir(parents=True)
        for name in COPIED:
            source = ROOT / name
            if name == "models":
                (copy / name).symlink_to(source)
            elif source.is_dir():
                shutil.copytree(source, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy(source, copy / name)
    return copy
