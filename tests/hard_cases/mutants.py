"""Does the suite bite? Put something else in a guard's place, in a fresh interpreter: its case must fail there.

`python -m tests.hard_cases.mutants NAME` runs one case without its guard: exit code 0 if it still holds, 17 if not.
"""

import importlib
import inspect
import os
import subprocess
import sys
import tempfile

from tests.hard_cases.registry import ROOT, Case, Guard, run
from tests.hard_cases.suite import CASES

MUTANTS = [case.name for case in CASES.values() if case.guard.instead is not None]
HOLDS, FAILS = 0, 17


def take_away(guard: Guard) -> None:
    """Put ``instead`` in the place of the guard, and under every name by which a module imported the same object."""
    owner, name, original = guard.resolve()
    replacement = guard.instead(original) if callable(guard.instead) else guard.instead
    setattr(owner, name, replacement)
    if inspect.ismodule(owner):
        for module in list(sys.modules.values()):
            for other, value in list(vars(module).items()):
                if value is original and (other == name or callable(original)):
                    setattr(module, other, replacement)


def compiled(guard: Guard) -> bool:
    """Whether numba compiles the symbol or a constant beside it into callers, which its cache would bring back."""
    module = importlib.import_module(guard.symbol.partition(":")[0])
    values = vars(module).values()
    return any(hasattr(value, "py_func") and value.__module__ == module.__name__ for value in values)


def survives(case: Case) -> bool:
    """Whether the case still holds without its guard; raises RuntimeError if it could not be tried."""
    with tempfile.TemporaryDirectory() as scratch:
        environment = os.environ | ({"NUMBA_CACHE_DIR": scratch} if compiled(case.guard) else {})
        command = [sys.executable, "-m", "tests.hard_cases.mutants", case.name]
        done = subprocess.run(
            command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False, timeout=600
        )
    if done.returncode not in (HOLDS, FAILS):
        raise RuntimeError(f"{case.name} could not be tried without its guard: {done.stderr[-400:]}")
    return done.returncode == HOLDS


def bitten(name: str) -> bool:
    """Whether the case fails without its guard; for a worker process."""
    return not survives(CASES[name])


if __name__ == "__main__":
    take_away(CASES[sys.argv[1]].guard)
    result = run(CASES[sys.argv[1]])
    print(result.worst, result.note, result.error)
    sys.exit(HOLDS if result.passed else FAILS)
