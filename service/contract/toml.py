"""Configuration files of every room: read alike, refused alike."""

import tomllib
from pathlib import Path
from typing import Any

from service.contract.frames import ContractError


def read_toml(path: str | Path) -> dict[str, Any]:
    """The table of a TOML file; raises OSError where there is no file to read, ContractError where it is no TOML.

    Not everything that is no TOML is a TOMLDecodeError: bytes that are no UTF-8, an integer of thousands of digits,
    brackets nested deeper than the stack.
    """
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ContractError(f"{path} is not valid TOML: {error}") from error
