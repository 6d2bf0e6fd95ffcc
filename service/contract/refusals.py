"""Texts for refusing a file, and for failing with one: the key, its allowed values, and the given value."""

import difflib
from collections.abc import Iterable
from typing import Any, Literal, cast, get_args, get_origin

from pydantic import BaseModel, ValidationError

SIGNS = (("gt", ">"), ("ge", ">="), ("lt", "<"), ("le", "<="))
UNION = {"int", "float"}  # which members of a union refused a value is part of an error's path, but no key
WORDS = {"model_type": "expected a table of keys", "tuple_type": "expected a list of values in brackets"}


def nearest(name: str, allowed_names: Iterable[str]) -> str:
    """A hint at the most similar allowed name, or at all of them if none is similar."""
    names = sorted(allowed_names)
    near = difflib.get_close_matches(name, names, n=1)
    return f"; did you mean {near[0]!r}?" if near else f"; allowed: {', '.join(names)}" if names else ""


def reason(error: Exception) -> str:
    """Why something failed, in words: of the system's errors the text and the file, without the number."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror + (f": {error.filename}" if error.filename else "")
    return str(error) or type(error).__name__


def _table(model: type[BaseModel], path: Iterable[int | str]) -> type[BaseModel] | None:
    """The table at a path of keys below a model, or None where there is none."""
    table: Any = model
    for key in path:
        field = table.model_fields.get(str(key))
        table = None if field is None else field.annotation
        if not (isinstance(table, type) and issubclass(table, BaseModel)):
            return None
    return cast("type[BaseModel]", table)


def allowed(table: type[BaseModel] | None, key: str) -> str:
    """The range of a number, e.g. ">= 0.005 and <= 5.0"; empty where the key has none."""
    field = table.model_fields.get(key) if table else None
    bounds = field.metadata if field else []
    return " and ".join(
        f"{sign} {getattr(bound, name)}" for name, sign in SIGNS for bound in bounds if hasattr(bound, name)
    )


def _missing(model: type[BaseModel], path: tuple[int | str, ...]) -> str:
    """That a key is missing, and what it holds: a table, a number in its range, one of its words."""
    if _table(model, path):
        return f"missing, {WORDS['model_type']}"
    table, key = _table(model, path[:-1]), str(path[-1])
    if bounds := allowed(table, key):
        return f"missing, expected a number {bounds}"
    field = table.model_fields.get(key) if table else None
    words = get_args(field.annotation) if field and get_origin(field.annotation) is Literal else ()
    return f"missing, expected one of {', '.join(map(str, words))}" if words else "missing"


def describe(error: ValidationError, model: type[BaseModel], above: str = "", *, secret: bool = False) -> str:
    """One line on the first error, unknown keys first: key, expectation, given value.

    ``above`` is the key of the table that ``model`` reads; ``secret``: the given value is not shown.
    """
    wrong = error.errors()
    first = next((one for one in wrong if one["type"] == "extra_forbidden"), wrong[0])
    keys = tuple(part for part in first["loc"] if part not in UNION)
    key = ".".join(str(part) for part in (above, *keys) if part != "")
    *parents, last = keys or ("",)
    table = _table(model, parents)
    if first["type"] == "extra_forbidden":
        what = f"unknown key{nearest(str(last), table.model_fields if table else ())}"
    elif first["type"] == "missing":
        what = _missing(model, keys)
    else:
        bounds = allowed(table, str(last))
        number = "a whole number" if first["type"].startswith("int_") and keys == first["loc"] else "a number"
        words = WORDS.get(first["type"], first["msg"].removeprefix("Value error, "))
        what = f"expected {number} {bounds}" if bounds else words
    given = "" if secret or first["type"] in {"value_error", "missing"} else f" (given: {first['input']!r})"
    return f"{key + ': ' if key else ''}{what}{given}"
