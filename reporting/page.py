"""A page is prose and tables in order. Prose is Markdown; the kit joins its lines and wraps them at 100 columns."""

import re
import textwrap
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from reporting.files import write_json
from reporting.table import Table
from service.durable import write_durably

COLUMNS = 100
TIED = re.compile(r" (?=%|(?:[0-9]+[.)]|[-+*>]|#+)(?: |$))")  # at the head of a line they would begin a list or heading


def page(*parts: str | Table) -> str:
    """The whole page as Markdown. Blank lines separate paragraphs; headings, pictures and comments keep their lines."""
    blocks = [block for part in parts for block in ([part.markdown()] if isinstance(part, Table) else _blocks(part))]
    return "\n\n".join(blocks) + "\n"


def _blocks(text: str) -> Iterator[str]:
    for block in textwrap.dedent(text).strip().split("\n\n"):
        if block.strip():
            yield _wrapped(block.strip())


def _wrapped(block: str) -> str:
    if block.startswith(("#", "![", "<!--", "|", "```")):
        return block
    items: list[list[str]] = []
    for line in block.splitlines():
        if line.startswith("- ") or not items:
            items.append([])
        items[-1].append(line.strip())
    return "\n".join(_filled(" ".join(item)) for item in items)


def _filled(paragraph: str) -> str:
    indent = "  " if paragraph.startswith("- ") else ""
    tied = TIED.sub("\N{NO-BREAK SPACE}", paragraph)
    text = textwrap.fill(tied, COLUMNS, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
    return text.replace("\N{NO-BREAK SPACE}", " ")


def missed_first(checks: Iterable[tuple[bool, str]], between: str = "; ") -> str:
    """Requirements and their results, as sentences: first those that fail, then those that hold."""
    rows = list(checks)
    paragraphs = (
        (heading, between.join(text for holds, text in rows if bool(holds) is wanted))
        for heading, wanted in (("**Missed:**", False), ("Reached:", True))
    )
    return "\n\n".join(f"{heading} {texts}." for heading, texts in paragraphs if texts)


def publish(folder: Path, name: str, text: str, data: Any = None) -> str:
    """Write ``name.md`` and, if there are data, ``name.json`` into the folder; returns the text."""
    folder.mkdir(parents=True, exist_ok=True)
    if data is not None:
        write_json(folder / f"{name}.json", data)
    write_durably(folder / f"{name}.md", text)
    return text
