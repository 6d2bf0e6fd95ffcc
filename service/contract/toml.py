"""Configuration files of every room: read alike, refused alike."""

import tomllib
from pathlib import Path
from typing import Any

from service.contract.frames import ContractError


def read_toml(path: str | Path) -> dict[str, Any]:
    """The table of a TOML file; raises OSError where there is no file to read, ContractError where it is no TOML."""
    return parse_toml(Path(path).read_bytes(), path)


def parse_toml(content: bytes, origin: str | Path) -> dict[str, Any]:
    """The table of a TOML file's bytes; raises ContractError, which names the origin, where they are no TOML.

    Not everything that is no TOML is a TOMLDecodeError: bytes that are no UTF-8, an integer of thousands of digits,
    brackets nested deeper than the stack.
    """
    try:
        return tomllib.loads(content.decode())
    except (ValueError, RecursionError) as error:
        raise ContractError(f"{origin} is not valid TOML: {error}") from error
