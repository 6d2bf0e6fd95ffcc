"""Configuration files of every package: read and refused in the same way."""

import tomllib
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
