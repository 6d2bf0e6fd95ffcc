"""The documentation's commands: every fenced shell block of all pages, with its marker.

A block that a machine without a robot cannot run carries, on the line before the fence, `<!-- not executed: why -->`.
"""

import re
import shlex
import textwrap
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SHELLS = {"sh", "bash", "shell", "console"}
_FENCE = re.compile(r"^( *)```(\S*)[^\n]*\n(.*?)^\1```", re.MULTILINE | re.DOTALL)
_MARKER = re.compile(r"<!--\s*not executed:\s*((?:(?!-->).)*?)\s*-->\s*\Z", re.DOTALL)


@dataclass(frozen=True)
class Block:
    """One fenced block: its place, its language, its text and, if it is not executed, the reason."""

    page: str
    line: int
    language: str
    text: str
    why_not: str | None

    @property
    def name(self) -> str:
        """Page and line, for the test's id."""
        return f"{self.page}:{self.line}"

    @property
    def script(self) -> str:
        """The typed text: in a `console` block the lines after a prompt, otherwise everything."""
        if self.language != "console":
            return self.text
        return "\n".join(line[2:] for line in self.text.splitlines() if line.startswith("$ "))

    def commands(self) -> list[list[str]]:
        """Each command split into words, without comments; lines that end in a backslash are joined."""
        lines = self.script.replace("\\\n", " ").splitlines()
        parts = [part for line in lines for part in re.split(r"\s(?:&&|\|\||\|)\s", line)]
        return [words for words in (shlex.split(part, comments=True) for part in parts) if words]


def pages() -> list[Path]:
    """The pages in the root, those of packages, and every page below docs/."""
    return [*sorted(ROOT.glob("*.md")), *sorted(ROOT.glob("[a-z]*/README.md")), *sorted((ROOT / "docs").rglob("*.md"))]


def blocks(page: Path) -> list[Block]:
    """The fenced blocks of a page, in order."""
    text = page.read_text()
    blocks = []
    for match in _FENCE.finditer(text):
        before = text[: match.start()]
        marker = _MARKER.search(before.rstrip("\n"))
        line = before.count("\n") + 1
        why_not = " ".join(marker[1].split()) if marker else None
        blocks.append(Block(str(page.relative_to(ROOT)), line, match[2], textwrap.dedent(match[3]), why_not))
    return blocks


def shell_blocks() -> list[Block]:
    """Every shell block of every page."""
    return [block for page in pages() for block in blocks(page) if block.language in SHELLS]


def spans(page: Path) -> list[str]:
    """The inline code of a page's sentences."""
    return [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", _FENCE.sub("", page.read_text()))]
