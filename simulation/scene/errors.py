"""What a refused scene is told: the key, what is allowed there, and what was given."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

SIGNS = (("gt", ">"), ("ge", ">="), ("lt", "<"), ("le", "<="))


def _field(model: type[BaseModel], path: Iterable[int | str]) -> FieldInfo | None:
    """The field at a path of keys below a model, or None where there is none."""
    found: FieldInfo | None = None
    current: Any = model
    for key in path:
        if not (isinstance(current, type) and issubclass(current, BaseModel)):
            return None
        found = current.model_fields.get(str(key))
        if found is None:
            return None
        current = found.annotation
    return found


def allowed(model: type[BaseModel], path: Iterable[int | str]) -> str:
    """The range of a number, e.g. ">= 0.005 and <= 5.0"; empty where the key has none."""
    field = _field(model, path)
    bounds = field.metadata if field is not None else []
    return " and ".join(
        f"{sign} {getattr(bound, name)}" for name, sign in SIGNS for bound in bounds if hasattr(bound, name)
    )


def describe(error: ValidationError, model: type[BaseModel]) -> str:
    """One line on the first thing wrong: key, what is expected, what was given."""
    first = error.errors()[0]
    key = ".".join(str(part) for part in first["loc"])
    if first["type"] == "extra_forbidden":
        what = "unknown key"
    else:
        bounds = allowed(model, first["loc"])
        what = f"expected a number {bounds}" if bounds else first["msg"]
    given = "" if first["type"] in {"value_error", "missing"} else f" (given: {first['input']!r})"
    return f"{key + ': ' if key else ''}{what}{given}"
