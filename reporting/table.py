"""A table is declared once, columns and rows, and written as Markdown or as plain text."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from reporting.statistics import Estimate, number

Key = str | int | Callable[[Any], Any]


class Column(NamedTuple):
    """A title, the place of the value in a row, and the value's format.

    ``key`` is an index, a function of the row, or the name of an entry or attribute, with dots for nesting:
    ``model.force_n``, ``0.name``. A column with a format holds numbers and is right-aligned.
    """

    title: str
    key: Key
    format: str = ""

    def cell(self, row: Any) -> str:
        return text_of(_value(row, self.key), self.format)


def text_of(value: Any, spec: str = "") -> str:
    """One cell: three numbers with a format are an estimate, other sequences are listed; ``-`` for None."""
    if isinstance(value, list | tuple):
        if spec and len(value) == len(Estimate._fields):
            return format(Estimate(*value), spec)
        return ", ".join(text_of(part, spec) for part in value)
    return str(value) if isinstance(value, str | bool) else number(value, spec)


def _value(row: Any, key: Key) -> Any:
    if callable(key):
        return key(row)
    if isinstance(key, int):
        return row[key]
    for name in key.split("."):
        row = row[name] if isinstance(row, Mapping) else row[int(name)] if name.isdigit() else getattr(row, name)
    return row


@dataclass(frozen=True, slots=True)
class Table:
    """Declared columns over rows of any kind; `table` makes one."""

    columns: tuple[Column, ...]
    rows: tuple[Any, ...]

    def cells(self) -> list[list[str]]:
        return [[column.cell(row) for column in self.columns] for row in self.rows]

    def markdown(self) -> str:
        """A pipe table; pipes and line ends inside cells are escaped."""
        marks = ["---:" if column.format else "---" for column in self.columns]
        body = [[_escaped(cell) for cell in row] for row in ([column.title for column in self.columns], *self.cells())]
        return "\n".join(f"| {' | '.join(row)} |" for row in (body[0], marks, *body[1:]))

    def text(self) -> str:
        """Aligned columns for a terminal."""
        body = [[column.title for column in self.columns], *self.cells()]
        widths = [max(map(len, cells)) for cells in zip(*body, strict=True)]
        return "\n".join(
            "  ".join(
                cell.rjust(width) if column.format else cell.ljust(width)
                for cell, width, column in zip(row, widths, self.columns, strict=True)
            ).rstrip()
            for row in body
        )


def table(rows: Iterable[Any], *columns: tuple[str, Key] | tuple[str, Key, str]) -> Table:
    """Rows under columns, each with a title, a key and optionally a format; see `Column`."""
    return Table(tuple(Column(*column) for column in columns), tuple(rows))


def _escaped(cell: str) -> str:
    return cell.replace("|", "\\|").replace("\n", " ")
