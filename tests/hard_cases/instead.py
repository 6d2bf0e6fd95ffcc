"""Replacements for a guard in the check: checks that pass everything, functions that ignore something."""

import math
from collections.abc import Callable
from types import FunctionType, ModuleType, SimpleNamespace
from typing import Any

import numpy as np


def waved_through(_check: object) -> Callable[..., None]:
    """Replaces a check: accepts everything."""
    return lambda *_arguments, **_options: None


def with_globals(**names: object) -> Callable[[Any], Any]:
    """In place of a function or class method: the same code where these global or built-in names mean otherwise."""

    def changed(function: Any) -> Any:
        if isinstance(function, classmethod):
            return classmethod(changed(function.__func__))
        scope = function.__globals__ | names
        twin = FunctionType(function.__code__, scope, function.__name__, function.__defaults__, function.__closure__)
        twin.__kwdefaults__ = function.__kwdefaults__
        return twin

    return changed


def like(module: ModuleType, **names: object) -> SimpleNamespace:
    """A module with some of its functions replaced."""
    return SimpleNamespace(**vars(module) | names)


blind = with_globals(
    np=like(np, isfinite=lambda values: np.ones(np.shape(values), np.bool_)), math=like(math, isfinite=lambda _: True)
)
"""In place of a function: it takes every number for a finite one."""
