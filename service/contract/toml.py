"""TOML files of every package: read, refused and written in the same way."""

import json
import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from service.contract.frames import ContractError


def read_toml(path: str | Path) -> dict[str, Any]:
    """The table of a TOML file; raises OSError if it cannot be read, ContractError if it is not TOML."""
    return parse_toml(Path(path).read_bytes(), path)


def parse_toml(content: bytes, origin: str | Path) -> dict[str, Any]:
    """The table of a TOML file's bytes; raises ContractError, which names the origin, if they are not TOML.

    Invalid TOML does not always raise a TOMLDecodeError: bytes that are not UTF-8, an integer of thousands of digits,
    brackets nested deeper than the stack. A byte order mark, which editors on Windows write, is ignored.
    """
    try:
        return tomllib.loads(content.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise ContractError(f"{origin} is not valid TOML: {error}") from error


def toml_text(tables: Mapping[str, Any]) -> str:
    """The text of a TOML file: plain keys, then each table; a line for every entry of a list of tables.

    What is None is left out.
    """
    plain = {key: value for key, value in tables.items() if not isinstance(value, Mapping)}
    parts = [_lines(plain)]
    parts += [f"[{_key(name)}]\n{_lines(table)}" for name, table in tables.items() if isinstance(table, Mapping)]
    return "\n".join(filter(None, parts))


def _lines(table: Mapping[str, Any]) -> str:
    return "".join(f"{pair}\n" for pair in _pairs(table))


def _pairs(table: Mapping[str, Any]) -> list[str]:
    return [f"{_key(key)} = {_value(value)}" for key, value in table.items() if value is not None]


def _key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else _value(key)


def _value(value: Any) -> str:
    match value:
        case Mapping():
            return (
                "{" + ", ".join(f"{_key(key)} = {_value(one)}" for key, one in value.items() if one is not None) + "}"
            )
        case str():
            return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
        case Sequence() if value and all(isinstance(one, Mapping) for one in value):
            return "[\n" + "".join(f"  {_value(one)},\n" for one in value) + "]"
        case Sequence():
            return "[" + ", ".join(map(_value, value)) + "]"
        case bool():
            return str(value).lower()
        case int() | float():  # as short as it is exact, also of numpy; inf and nan are TOML's words, too
            return (float if isinstance(value, float) else int).__repr__(value)
    raise TypeError(f"no TOML for {value!r}")
