"""Text for others: escaped foreign text, addresses without passwords, wrapped lines, how a command ends."""

import argparse
import difflib
import os
import re
import select
import sys
import textwrap
from collections.abc import Callable
from typing import Any, NoReturn
from urllib.parse import SplitResult, urlsplit

from service.contract.refusals import reason

WIDTH = 80
_ADDRESS = re.compile(r"(?!file:)[A-Za-z][A-Za-z0-9+.-]*://")


def printable(line: str) -> str:
    r"""The same line with everything that a terminal would obey written out: ``\x1b``, ``\n``, ``\u202e``."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape", "replace").decode() for c in line)


def without_secrets(url: str) -> str:
    """An address as everybody may read it: without user, password and query; any other text as it is.

    Of an address that :func:`split_address` cannot split, only the scheme is shown.
    """
    scheme = _ADDRESS.match(url)
    if scheme is None:
        return url
    if (parts := split_address(url)) is None:
        return f"{scheme[0]}..."
    return f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}{parts.path}{'?...' if parts.query else ''}"


def split_address(url: str) -> SplitResult | None:
    """The parts of an address, None where a part of its password may stand in another one, as after a raw slash."""
    try:
        parts = urlsplit(url)
        if parts.port == 0 or "@" in f"{parts.path}{parts.query}{parts.fragment}":
            return None
    except ValueError:  # such as a password's beginning in the place of the port
        return None
    return parts


def fitted(line: str, indent: int | None = None, width: int = WIDTH) -> str:
    """The line in at most ``width`` columns, with its continuation lines indented.

    By default they are indented below the text after the line's own label. A line whose longest word, for example a
    path, would not fit anyway stays whole.
    """
    if indent is None:
        label = re.match(r" *(\S+ )*\S+ {2,}", line[:24])
        indent = label.end() if label else len(line) - len(line.lstrip()) + 2
    if len(line) <= width or max(map(len, line.split())) > width - indent:
        return line
    return textwrap.fill(line, width, subsequent_indent=" " * indent, break_long_words=False, break_on_hyphens=False)


def run_command(
    name: str,
    work: Callable[[], int],
    refused: tuple[type[Exception], ...] = (ValueError, OSError),
    *,
    resumes: bool = False,
) -> int:
    """Exit status of a command: that of its work; 2 and one line for wrong input; 130 and one line after Ctrl-C.

    ``refused``: raised for wrong input; the variable TACTILE_TRACEBACK shows where. Silently 1 if nobody reads standard
    output any more, as after ``| head``. ``resumes``: the same command goes on after Ctrl-C.
    """
    try:
        return _read_by_somebody(work)
    except KeyboardInterrupt:
        print(f"{name}: interrupted{'; the same command goes on' if resumes else ''}", file=sys.stderr)
        return 130
    except refused as error:
        if os.environ.get("TACTILE_TRACEBACK"):
            raise
        print(printable(f"{name}: {' '.join(reason(error).split())}"), file=sys.stderr)
        return 2


def _read_by_somebody(work: Callable[[], int]) -> int:
    """Result of the work; silently 1 if nobody reads standard output any more."""
    try:
        code = work()
        sys.stdout.flush()
    except BrokenPipeError:
        output = select.poll()
        output.register(sys.stdout.fileno(), 0)
        if not output.poll(0):  # its other end is there: another pipe broke
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return code


class Parser(argparse.ArgumentParser):
    """A parser that refuses in one line with the nearest option. All are typed in full, above all `--live`."""

    def __init__(self, *arguments: Any, **settings: Any) -> None:
        super().__init__(*arguments, **{**settings, "allow_abbrev": False})

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Refuse here what is unknown: the parser above a command knows none of its options."""
        parsed, unknown = super().parse_known_args(args, namespace)
        if unknown:
            word = unknown[0].partition("=")[0]
            near = difflib.get_close_matches(word, self._option_string_actions, n=1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            self.error(f"unrecognized arguments: {' '.join(unknown)}{hint}")
        return parsed, unknown

    def error(self, message: str) -> NoReturn:
        """Exit with status 2 and one line."""
        self.exit(2, printable(f"{self.prog}: {message} (`{self.prog} --help` tells all options)") + "\n")
