"""Text for others: escaping of foreign text, addresses without passwords, wrapped lines, a reader who has left."""

import os
import re
import select
import sys
import textwrap
from collections.abc import Callable
from urllib.parse import urlsplit

WIDTH = 80


def printable(line: str) -> str:
    r"""The same line with everything that a terminal would obey written out: ``\x1b``, ``\n``, ``\u202e``."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape", "replace").decode() for c in line)


def without_secrets(url: str) -> str:
    """An http address as everybody may read it: without user, password and query; any other text as it is."""
    if not url.startswith(("http://", "https://")):
        return url
    parts = urlsplit(url)
    return f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}{parts.path}{'?...' if parts.query else ''}"


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


def read_by_somebody(work: Callable[[], int]) -> int:
    """Result of the work; silently 1 if nobody reads standard output any more, as after ``| head``."""
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
